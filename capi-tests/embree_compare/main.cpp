// Bakelite against Embree 3 on the same scenes and the same rays, side by side: rates of every kind of ray, time,
// memory and SAH cost of commits, and every ray on which the two disagree, judged by an oracle of its own in extended
// precision.
//
//     embree_compare SCENE... [OPTIONS]
//
//     SCENE              a file (.obj .ply .gltf .glb) or a built-in name
//     --only PART        rays or commits (default: both)
//     --kinds LIST       as "one by one,tile to lamp": kinds of rays (default: all)
//     --rays N           rays per kind (default 500000)
//     --pairs P          pairs of runs per ratio (default 5)
//     --seed S           of all random numbers (default 1)
//     --threads LIST     as 1,2: threads, each tracing its share by single-thread calls; of commits the devices'
//                        (default 1)
//     --isa NAME         portable, avx2, avx512 (default: the best), or all: each that both sides have here, Embree
//                        with the same one, that is SSE2, AVX2 or AVX-512
//     --embree-isa NAME  sse2, sse4.2, avx, avx2, avx512 (default: its own choice, unless --isa is all)
//     --build LIST       builds of ours that rays are traced on: default, high or both (default: default)
//     --repeat LIST      as 1,4,12: each scene so many times, beside itself (default 1)
//     --instances        as instances of one mesh instead of copies, on both sides: rays alone
//     --markdown         tables ready for a document, at the end; all other text goes to stderr
//     --csv FILE         all figures
//
// A ratio is the median over alternating pairs (ours, Embree's) of our rate to Embree's; rates are medians, too. Rays
// are timed by what a thread has run (of several threads the slowest), commits on one thread by what the process has
// run: on a quiet machine that is the wall clock's time, on a busy one it leaves out what others took. Commits on
// several threads want a quiet machine. Embree gets its rays ready in its own layout and keeps its results in its own
// packets: only the copy into the structure that it traces is timed. Both sides run with denormals flushed to zero.
//
// If CMake knows BAKELITE_TINYBVH_DIR, the folder of tiny_bvh.h, tinybvh's trees trace the same rays too, one by one: as
// AVX2 code, whatever --isa says, with its own triangle test, which is not watertight.
//
// "default", "high" and "robust" are Embree's scenes of default quality, with RTC_BUILD_QUALITY_HIGH, and with
// RTC_SCENE_FLAG_ROBUST. Commits are compared like with like: its high with our BK_BUILD_QUALITY_HIGH, the others with
// our default; ratios of bytes and SAH cost are ours to Embree's, the less the better.
//
// Disagreements are counted against Embree's robust rtcIntersect1 or rtcOccluded1; judge.h says by which classes. After
// a real one, for which the oracle agrees with Embree, the exit code is 1.
//
// | file    | what                                          |
// |---------|-----------------------------------------------|
// | scene   | one scene on both sides                       |
// | rays    | the kinds of rays, and the ways to trace them |
// | judge   | disagreements                                 |
// | tinybvh | other ray tracers                             |
// | build   | time, memory and SAH cost of commits          |
// | report  | CSV and Markdown                              |

#include "build.h"
#include "report.h"
#include "tinybvh.h"

#include <atomic>
#include <cstdlib>
#include <thread>

namespace {

// ---------------------------------------------------------------------------------------------
// The command line.

struct Options {
    std::vector<std::string> scenes;
    std::string csv, embree_isa;
    bool rays_too = true, commits_too = true, markdown = false, all_isas = false, instances = false;
    size_t rays = 500000;
    std::vector<unsigned> threads = {1};
    std::vector<size_t> kinds;
    std::vector<uint32_t> qualities = {BK_BUILD_QUALITY_DEFAULT};
    std::vector<unsigned> repeats = {1};
    unsigned pairs = 5;
    uint64_t seed = 1;
    uint32_t isa = BK_ISA_AUTO;

    // Where text goes.
    std::FILE *text() const { return markdown ? stderr : stdout; }
};

unsigned long number(const std::string &text, const std::string &option, unsigned long low, unsigned long high) {
    char *end = nullptr;
    const unsigned long value = std::strtoul(text.c_str(), &end, 10);
    if (text.empty() || text[0] < '0' || text[0] > '9' || *end || value < low || value > high) {
        fail(option + " wants a number from " + std::to_string(low) + " to " + std::to_string(high) + ", not " + text);
    }
    return value;
}

std::vector<std::string> list(const std::string &text) {
    std::vector<std::string> items;
    for (size_t start = 0, end; start <= text.size(); start = end + 1) {
        end = std::min(text.find(',', start), text.size());
        items.push_back(text.substr(start, end - start));
    }
    return items;
}

template <size_t N>
uint32_t one_of(const char *const (&names)[N], const std::string &value, const std::string &option) {
    const auto found = std::find(std::begin(names), std::end(names), value);
    if (found == std::end(names)) fail(option + " does not know " + value);
    return uint32_t(found - std::begin(names));
}

Options parse(int argc, char **argv) {
    const char *usage =
        "usage: embree_compare SCENE... [--only rays|commits] [--kinds LIST] [--rays N] [--pairs P] [--seed S]\n"
        "    [--threads LIST] [--isa NAME|all] [--embree-isa NAME] [--build LIST] [--repeat LIST] [--instances]\n"
        "    [--markdown] [--csv FILE]";
    Options o;
    for (int i = 1; i < argc; i++) {
        const std::string arg = argv[i];
        if (arg.compare(0, 2, "--") != 0) {
            o.scenes.push_back(arg);
            continue;
        }
        if (arg == "--markdown") {
            o.markdown = true;
            continue;
        }
        if (arg == "--instances") {
            o.instances = true;
            continue;
        }
        if (i + 1 == argc) fail(arg == "--help" ? usage : arg + " wants a value");
        const std::string value = argv[++i];
        if (arg == "--only") {
            if (value != "rays" && value != "commits") fail("--only wants rays or commits, not " + value);
            o.rays_too = value == "rays", o.commits_too = value == "commits";
        } else if (arg == "--kinds") {
            for (const std::string &kind : list(value)) o.kinds.push_back(one_of(KIND_NAMES, kind, arg));
        } else if (arg == "--rays") {
            o.rays = number(value, arg, STREAM, 100000000);
        } else if (arg == "--pairs") {
            o.pairs = unsigned(number(value, arg, 1, 1000));
        } else if (arg == "--seed") {
            o.seed = number(value, arg, 0, ~0ul);
        } else if (arg == "--threads") {
            o.threads.clear();
            for (const std::string &n : list(value)) o.threads.push_back(unsigned(number(n, arg, 1, 1024)));
        } else if (arg == "--build") {
            o.qualities.clear();
            for (const std::string &q : list(value)) o.qualities.push_back(one_of(QUALITY_NAMES, q, arg));
        } else if (arg == "--repeat") {
            o.repeats.clear();
            for (const std::string &n : list(value)) o.repeats.push_back(unsigned(number(n, arg, 1, 100000)));
        } else if (arg == "--isa") {
            o.all_isas = value == "all";
            if (!o.all_isas) o.isa = one_of(ISA_NAMES, value, arg);
        } else if (arg == "--embree-isa") {
            o.embree_isa = value;
        } else if (arg == "--csv") {
            o.csv = value;
        } else {
            fail("there is no option " + arg);
        }
    }
    if (o.scenes.empty()) fail(usage);
    if (o.instances) {
        if (!o.rays_too) fail("--instances is for rays");
        o.commits_too = false;
    }
    if (o.kinds.empty()) {
        for (size_t kind = 0; kind < KINDS; kind++) o.kinds.push_back(kind);
    }
    if (o.all_isas && !o.embree_isa.empty()) fail("--isa all chooses Embree's, too");
    return o;
}

// The ISAs to compare, by the option.
std::vector<Setup> setups(const Options &o) {
    std::vector<Setup> found;
    if (!o.all_isas) {
        Setup setup;
        setup.isa = o.isa;
        setup.embree_isa = o.embree_isa;
        return {setup};
    }
    for (const auto &[ours, theirs] : {std::make_pair(BK_ISA_PORTABLE, "sse2"), std::make_pair(BK_ISA_AVX2, "avx2"),
                                       std::make_pair(BK_ISA_AVX512, "avx512")}) {
        Setup setup;
        setup.isa = uint32_t(ours);
        setup.embree_isa = theirs;
        bk_device *const device = our_device(setup, 1);
        const RTCDevice embree = embree_device(setup, 1);
        if (device && embree) found.push_back(setup);
        if (embree) rtcReleaseDevice(embree);
        bk_device_release(device);
    }
    return found;
}

// ---------------------------------------------------------------------------------------------
// Rays.

// What the slowest thread has run: the time it takes where each has a core of its own.
double seconds(const Run &run, size_t count, size_t unit, unsigned threads) {
    if (threads == 1) {
        const double start = thread_seconds();
        run(0, count);
        return thread_seconds() - start;
    }
    std::atomic<unsigned> ready{0};
    std::atomic<bool> go{false};
    std::vector<double> took(threads);
    std::vector<std::thread> workers;
    const size_t units = count / unit;
    for (unsigned t = 0; t < threads; t++) {
        workers.emplace_back([&, t] {
            flush_denormals();
            ready++;
            while (!go) std::this_thread::yield();
            const double start = thread_seconds();
            run(units * t / threads * unit, units * (t + 1) / threads * unit);
            took[t] = thread_seconds() - start;
        });
    }
    while (ready < threads) std::this_thread::yield();
    go = true;
    for (std::thread &w : workers) w.join();
    return *std::max_element(took.begin(), took.end());
}

struct Rate {
    double mrays = 0, ratio = 0;
    double fastest = 0; // Mrays/s in Embree's fastest run
};

// Alternating pairs of ours and one of Embree's ways; adds our times to `ours`.
Rate compare(const Kind &k, const EmbreeRun &way, RTCScene scene, unsigned threads, unsigned pairs,
             std::vector<double> &ours) {
    const size_t count = k.rays.rays.size();
    const Run theirs = [&](size_t begin, size_t end) { way(scene, begin, end); };
    std::vector<double> times, ratios;
    for (unsigned p = 0; p < pairs; p++) {
        const double a = seconds(k.ours, count, k.unit, threads), b = seconds(theirs, count, k.unit, threads);
        ours.push_back(a);
        times.push_back(b);
        ratios.push_back(b / a);
    }
    return {double(count) / median(times) * 1e-6, median(ratios),
            double(count) / *std::min_element(times.begin(), times.end()) * 1e-6};
}

// Runs one kind of ray, prints its lines and adds its rows, which are like `row`. Returns its real disagreements.
size_t run_kind(Kind &k, const Scene &s, const EmbreeScenes &embree, const Options &o, Row row,
                std::vector<Row> &rows) {
    const size_t count = k.rays.rays.size();
    k.ours(0, count);
    row.counts = verify(k, s, embree.of[ROBUST]);
    row.what = k.name;
    row.unit = "Mrays/s";

    const Counts &c = row.counts;
    std::fprintf(
        o.text(),
        "%-13s %8zu rays, %zu hits, %zu misses; disagreements: %zu same t, %zu grazing, %zu theirs, %zu real\n", k.name,
        count, c.hits, c.misses, c.of[SameT], c.of[Grazing], c.of[Theirs], c.of[Real]);
    // Right between points of a convex room, elsewhere no measure of anything.
    if (2 * c.hits < count) std::fprintf(o.text(), "  MOST OF THESE RAYS MISS\n");
    for (const unsigned threads : o.threads) {
        std::vector<double> our_times, uncounted;
        std::vector<Rate> rates;
        // The first runs on more threads wake cores.
        if (threads > 1) compare(k, k.ways[0].run, embree.of[DEFAULT], threads, 1, uncounted);
        for (const Way &way : k.ways) {
            for (RTCScene scene : embree.of) rates.push_back(compare(k, way.run, scene, threads, o.pairs, our_times));
        }
        row.threads = threads;
        row.ours = double(count) / median(our_times) * 1e-6;
        std::fprintf(o.text(), "  %-32s %8.3f   %u thread%s\n", "bakelite", row.ours, threads, threads == 1 ? "" : "s");
        // By the fastest run, which noise spoils least. (The least of several ratios would be the noisiest.)
        Rate best[MODES];
        for (size_t w = 0; w < k.ways.size(); w++) {
            row.way = k.ways[w].name;
            std::fprintf(o.text(), "  %-32s", k.ways[w].name.c_str());
            for (int mode = 0; mode < MODES; mode++) {
                const Rate &r = rates[w * MODES + size_t(mode)];
                if (r.fastest > best[mode].fastest) best[mode] = r;
                std::fprintf(o.text(), " %8.3f %7.2fx  ", r.mrays, r.ratio);
                row.mode = Mode(mode);
                row.embree = r.mrays;
                row.fastest = r.fastest;
                row.ratio = r.ratio;
                rows.push_back(row);
            }
            std::fprintf(o.text(), "\n");
        }
        std::fprintf(o.text(), "  %-32s", "against the best of them");
        for (const Rate &r : best) std::fprintf(o.text(), " %8.3f %7.2fx  ", r.mrays, r.ratio);
        std::fprintf(o.text(), "\n");
    }
    std::fprintf(o.text(), "\n");
    std::fflush(o.text());
    return c.of[Real];
}

// Runs a peer on one kind of ray, prints its lines and adds its rows. What its hits differ in from ours is counted, not
// judged: ours have been judged against Embree's.
void run_peer(const Kind &k, Peer &peer, const Options &o, Row row, std::vector<Row> &rows) {
    const size_t count = k.rays.rays.size();
    peer.prepare(k);
    for (const unsigned threads : o.threads) {
        std::vector<double> our_times;
        const EmbreeRun way = [&peer](RTCScene, size_t begin, size_t end) { peer.run(begin, end); };
        const Rate r = compare(k, way, nullptr, threads, o.pairs, our_times);
        size_t hits = 0, distances = 0;
        for (size_t i = 0; i < count; i++) {
            const bool ours = k.occlusion ? k.occluded[i] != 0 : k.hits[i].triangle != BK_NONE;
            if (ours != peer.is_hit(i)) {
                hits++;
            } else if (!k.occlusion && ours && std::abs(peer.t(i) / k.hits[i].t - 1) > 1e-4f) {
                distances++;
            }
        }
        row.what = k.name;
        row.unit = "Mrays/s";
        row.threads = threads;
        row.way = peer.name();
        row.mode = PEER;
        row.ours = double(count) / median(our_times) * 1e-6;
        row.embree = r.mrays;
        row.fastest = r.fastest;
        row.ratio = r.ratio;
        rows.push_back(row);
        std::fprintf(o.text(), "  %-32s %8.3f %7.2fx   %u thread%s; hit or miss differs: %zu, t by 1e-4: %zu\n",
                     row.way.c_str(), row.embree, row.ratio, threads, threads == 1 ? "" : "s", hits, distances);
    }
}

size_t run_rays(const Scene &s, const Setup &setup, const Options &o, const Row &row, std::vector<Row> &rows) {
    const EmbreeScenes embree(s, setup);
    std::fprintf(o.text(), "%-34s", ("Mrays/s, our " + row.build + " build").c_str());
    for (int mode = 0; mode < MODES; mode++) {
        std::fprintf(o.text(), " %17s  ", (std::string("Embree ") + MODE_NAMES[mode]).c_str());
    }
    std::fprintf(o.text(), "\n");
    const std::vector<std::unique_ptr<Peer>> others =
        s.places.empty() ? peers(s) : std::vector<std::unique_ptr<Peer>>();
    size_t real = 0;
    for (const size_t kind : o.kinds) {
        Kind k;
        make_kind(k, kind, s, o.rays, o.seed);
        real += run_kind(k, s, embree, o, row, rows);
        for (const std::unique_ptr<Peer> &peer : others) run_peer(k, *peer, o, row, rows);
        if (!others.empty()) std::fprintf(o.text(), "\n");
    }
    return real;
}

// ---------------------------------------------------------------------------------------------
// Commits.

void run_commits(const Scene &s, const Setup &setup, const Options &o, Row row, std::vector<Row> &rows) {
    const double triangles = double(s.stats.triangles);
    // Prints a line of it, too.
    const auto add = [&](const char *what, const char *unit, double ours, double embree, double ratio) {
        row.what = what;
        row.unit = unit;
        row.ours = ours;
        row.embree = embree;
        row.ratio = ratio;
        rows.push_back(row);
        std::fprintf(o.text(), "  %-8s %-15s %7s %8.2f   Embree %-8s %8.2f %7.2fx", what, unit, row.build.c_str(), ours,
                     MODE_NAMES[row.mode], embree, ratio);
        std::fprintf(o.text(), row.what == COMMIT ? "   %u thread%s\n" : "\n", row.threads,
                     row.threads == 1 ? "" : "s");
    };
    std::fprintf(o.text(), "Commits, ours and Embree's\n");
    for (const Mode mode : {DEFAULT, HIGH, ROBUST}) {
        const uint32_t quality = mode == HIGH ? BK_BUILD_QUALITY_HIGH : BK_BUILD_QUALITY_DEFAULT;
        row.build = QUALITY_NAMES[quality];
        row.mode = mode;
        for (const unsigned threads : o.threads) {
            row.threads = threads;
            const CommitTimes t = time_commits(s, setup, mode, threads, o.pairs);
            add(COMMIT, "Mtriangles/s", triangles / t.ours * 1e-6, triangles / t.embree * 1e-6, t.ratio);
        }
        row.threads = 1;
        const OurTree ours = our_tree(s, quality);
        const Bytes embree = embree_bytes(s, setup, mode);
        add(TREE, "bytes/triangle", ours.bytes.tree / triangles, embree.tree / triangles,
            ours.bytes.tree / embree.tree);
        add(SCENE, "bytes/triangle", ours.bytes.scene / triangles, embree.scene / triangles,
            ours.bytes.scene / embree.scene);
        // The robust tree is the default one with other leaves.
        if (mode == ROBUST) continue;
        const double sah = embree_sah(s, setup, mode);
        add(SAH, "", ours.sah, sah, ours.sah / sah);
    }
    std::fprintf(o.text(), "\n");
    std::fflush(o.text());
}

size_t run_scene(const std::string &name, Setup setup, const Options &o, std::vector<Row> &rows) {
    size_t real = 0;
    bool first = true;
    for (const uint32_t quality : o.qualities) {
        setup.quality = quality;
        const Scene s(name, setup);
        Row row;
        row.scene = setup.times == 1 ? name : name + " x " + std::to_string(setup.times);
        if (setup.instances) row.scene += " instances";
        row.isa = ISA_NAMES[bk_device_isa(s.device)];
        row.embree_isa = setup.embree_isa.empty() ? "best" : setup.embree_isa;
        row.build = QUALITY_NAMES[quality];
        if (first) {
            std::fprintf(o.text(), "%s: %llu triangles (%llu degenerate), Bakelite %s, Embree %d.%d.%d %s, %u pairs\n",
                         row.scene.c_str(), static_cast<unsigned long long>(s.stats.triangles),
                         static_cast<unsigned long long>(s.stats.skipped_degenerate), row.isa.c_str(),
                         RTC_VERSION_MAJOR, RTC_VERSION_MINOR, RTC_VERSION_PATCH, row.embree_isa.c_str(), o.pairs);
            if (o.commits_too) run_commits(s, setup, o, row, rows);
        }
        first = false;
        if (o.rays_too) real += run_rays(s, setup, o, row, rows);
    }
    return real;
}

} // namespace

int main(int argc, char **argv) {
    const Options o = parse(argc, argv);
    flush_denormals();
    std::vector<Row> rows;
    size_t real = 0;
    for (const std::string &scene : o.scenes) {
        for (Setup setup : setups(o)) {
            for (const unsigned times : o.repeats) {
                setup.times = times;
                setup.instances = o.instances;
                real += run_scene(scene, setup, o, rows);
            }
        }
    }
    if (!o.csv.empty()) write_csv(o.csv, rows);
    if (o.markdown) print_markdown(stdout, rows);
    if (real) std::fprintf(stderr, "%zu real disagreements\n", real);
    return real ? 1 : 0;
}
