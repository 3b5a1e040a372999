#include "report.h"

#include <fstream>

const char *const COMMIT = "commit", *const TREE = "tree", *const SCENE = "scene", *const SAH = "SAH cost";

void write_csv(const std::string &path, const std::vector<Row> &rows) {
    std::ofstream csv(path);
    csv << "scene,isa,embree_isa,threads,build,what,unit,ours,embree_way,embree_mode,embree,ratio,"
           "hits,misses,same_t,grazing,theirs,real\n";
    for (const Row &r : rows) {
        csv << r.scene << ',' << r.isa << ',' << r.embree_isa << ',' << r.threads << ',' << r.build << ',' << r.what
            << ',' << r.unit << ',' << r.ours << ',' << r.way << ',' << MODE_NAMES[r.mode] << ',' << r.embree << ','
            << r.ratio << ',' << r.counts.hits << ',' << r.counts.misses << ',' << r.counts.of[SameT] << ','
            << r.counts.of[Grazing] << ',' << r.counts.of[Theirs] << ',' << r.counts.of[Real] << '\n';
    }
    if (!csv.flush()) fail("cannot write " + path);
}

namespace {

std::string number(double value, int digits) {
    char text[64];
    std::snprintf(text, sizeof text, "%.*f", digits, value);
    return text;
}

// The file's name without its folder and ending, and how often it stands beside itself.
std::string short_name(const std::string &scene) {
    const size_t slash = scene.find_last_of("/\\"), start = slash == std::string::npos ? 0 : slash + 1;
    const size_t end = scene.find_last_of('.'), times = scene.rfind(" x ");
    return scene.substr(start, std::min(end, times) - start) + (times == std::string::npos ? "" : scene.substr(times));
}

// The first cells of a line: where and how something was measured.
std::string place(const Row &r) {
    return "| " + short_name(r.scene) + " | " + r.isa + ", " + r.embree_isa + " | " + std::to_string(r.threads) +
           " | " + r.build + " |";
}
const char *const PLACE_HEAD = "| scene | ISA, Embree's | threads | build |", *const PLACE_RULE = "|---|---|---|---|";

// The places that were measured, in order, each once.
std::vector<std::string> places(const std::vector<Row> &rows, const std::string &unit) {
    std::vector<std::string> found;
    for (const Row &r : rows) {
        if (r.unit == unit && std::find(found.begin(), found.end(), place(r)) == found.end()) found.push_back(place(r));
    }
    return found;
}

// The row of Embree's fastest way, by its fastest run; NULL if there is none.
const Row *best(const std::vector<Row> &rows, const std::string &at, const std::string &what, Mode mode) {
    const Row *found = nullptr;
    for (const Row &r : rows) {
        if (place(r) == at && r.what == what && r.mode == mode && (!found || r.fastest > found->fastest)) found = &r;
    }
    return found;
}

// Ours and those of each peer, if there are any.
void print_peers(std::FILE *out, const std::vector<Row> &rows, const std::vector<std::string> &lines) {
    std::vector<std::string> names;
    for (const Row &r : rows) {
        if (r.mode == PEER && std::find(names.begin(), names.end(), r.way) == names.end()) names.push_back(r.way);
    }
    for (const std::string &name : names) {
        std::string head = PLACE_HEAD, rule = PLACE_RULE;
        for (const char *kind : KIND_NAMES) head += std::string(" ") + kind + " |", rule += "---|";
        std::fprintf(out, "\nMrays/s of %s, and ours to them.\n\n%s\n%s\n", name.c_str(), head.c_str(), rule.c_str());
        for (const std::string &at : lines) {
            std::string line = at;
            for (const char *kind : KIND_NAMES) {
                const auto is_it = [&](const Row &r) {
                    return r.mode == PEER && r.way == name && r.what == kind && place(r) == at;
                };
                const auto r = std::find_if(rows.begin(), rows.end(), is_it);
                line += " " + (r == rows.end() ? "" : number(r->embree, 2) + ", " + number(r->ratio, 2)) + " |";
            }
            std::fprintf(out, "%s\n", line.c_str());
        }
    }
}

void print_rays(std::FILE *out, const std::vector<Row> &rows) {
    const std::vector<std::string> lines = places(rows, "Mrays/s");
    if (lines.empty()) return;
    std::string head = PLACE_HEAD, rule = PLACE_RULE;
    for (const char *kind : KIND_NAMES) head += std::string(" ") + kind + " |", rule += "---|";
    std::fprintf(out, "Rays per second, ours to those of Embree's fastest way: default / high / robust.\n\n%s\n%s\n",
                 head.c_str(), rule.c_str());
    for (const std::string &at : lines) {
        std::string line = at;
        for (const char *kind : KIND_NAMES) {
            for (int mode = 0; mode < MODES; mode++) {
                const Row *const r = best(rows, at, kind, Mode(mode));
                line += (mode ? " / " : " ") + (r ? number(r->ratio, 2) : "");
            }
            line += " |";
        }
        std::fprintf(out, "%s\n", line.c_str());
    }
    std::fprintf(out, "\nMrays/s, ours and those of Embree's fastest way on its default build.\n\n%s\n%s\n",
                 head.c_str(), rule.c_str());
    for (const std::string &at : lines) {
        std::string line = at;
        for (const char *kind : KIND_NAMES) {
            const Row *const r = best(rows, at, kind, DEFAULT);
            line += " " + (r ? number(r->ours, 2) + " and " + number(r->embree, 2) : "") + " |";
        }
        std::fprintf(out, "%s\n", line.c_str());
    }
    print_peers(out, rows, lines);
    Counts sum;
    size_t rays = 0;
    std::vector<std::string> seen;
    for (const Row &r : rows) {
        // Counted once, whatever the number of threads, ways and modes.
        const std::string key = r.scene + '|' + r.isa + '|' + r.build + '|' + r.what;
        if (r.unit != "Mrays/s" || std::find(seen.begin(), seen.end(), key) != seen.end()) continue;
        seen.push_back(key);
        rays += r.counts.hits + r.counts.misses;
        for (int c = 0; c < 5; c++) sum.of[c] += r.counts.of[c];
    }
    std::fprintf(out, "\n%zu rays; disagreements: %zu same t, %zu grazing, %zu theirs, %zu real.\n\n", rays,
                 sum.of[SameT], sum.of[Grazing], sum.of[Theirs], sum.of[Real]);
}

void print_commits(std::FILE *out, const std::vector<Row> &rows) {
    const std::vector<std::string> lines = places(rows, "Mtriangles/s");
    if (lines.empty()) return;
    std::fprintf(out, "Commits, million triangles per second.\n\n%s Bakelite | Embree | ratio |\n%s---|---|---|\n",
                 PLACE_HEAD, PLACE_RULE);
    for (const std::string &at : lines) {
        for (const Row &r : rows) {
            if (place(r) != at || r.what != COMMIT || r.mode == ROBUST) continue;
            std::fprintf(out, "%s %.2f | %.2f | %.2f |\n", at.c_str(), r.ours, r.embree, r.ratio);
        }
    }
    std::fprintf(out, "\n");
}

void print_trees(std::FILE *out, const std::vector<Row> &rows) {
    const std::vector<std::string> lines = places(rows, "bytes/triangle");
    if (lines.empty()) return;
    std::fprintf(out,
                 "Bytes per triangle of the tree with its leaves, and of the whole scene; SAH cost.\n\n"
                 "%s tree | Embree's | its robust one | scene | Embree's | its robust one | SAH cost | Embree's |\n"
                 "%s---|---|---|---|---|---|---|---|\n",
                 PLACE_HEAD, PLACE_RULE);
    for (const std::string &at : lines) {
        std::string line = at;
        for (const char *what : {TREE, SCENE, SAH}) {
            const Row *const a = best(rows, at, what, DEFAULT), *const b = best(rows, at, what, HIGH),
                             *const robust = best(rows, at, what, ROBUST), *const same = a ? a : b;
            const int digits = what == SAH ? 1 : 0;
            line += " " + (same ? number(same->ours, digits) + " | " + number(same->embree, digits) : "|") + " |";
            if (what != SAH) line += " " + (robust ? number(robust->embree, digits) : "") + " |";
        }
        std::fprintf(out, "%s\n", line.c_str());
    }
    std::fprintf(out, "\n");
}

} // namespace

void print_markdown(std::FILE *out, const std::vector<Row> &rows) {
    print_rays(out, rows);
    print_commits(out, rows);
    print_trees(out, rows);
}
