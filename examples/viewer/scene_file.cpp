// Wavefront OBJ with MTL, and binary PLY. bk_scene_load_file reads these formats too, and more of
// them; the viewer has readers of its own because it draws the colours of materials, and to show how
// geometry that a program has in memory is handed over.

#include "scene_file.h"

#include <algorithm>
#include <array>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <map>
#include <sstream>
#include <stdexcept>
#include <unordered_map>

namespace {

[[noreturn]] void fail(const std::string &path, const std::string &what) {
    throw std::runtime_error(path + ": " + what);
}

bool ends_with(const std::string &text, const std::string &end) {
    return text.size() >= end.size() && text.compare(text.size() - end.size(), end.size(), end) == 0;
}

std::string read_file(const std::string &path) {
    std::ifstream in(path, std::ios::binary);
    if (!in) fail(path, "cannot be read");
    return {std::istreambuf_iterator<char>(in), {}};
}

// Calls line(keyword, rest) for each line.
template <class F> void each_line(const std::string &text, F line) {
    for (size_t begin = 0; begin < text.size();) {
        const size_t end = std::min(text.find('\n', begin), text.size());
        size_t last = end;
        while (last > begin && std::strchr(" \t\r", text[last - 1])) last--;
        const size_t space = std::min(text.find_first_of(" \t", begin), last);
        const size_t rest = std::min(text.find_first_not_of(" \t", space), last);
        line(text.substr(begin, space - begin), text.substr(rest, last - rest));
        begin = end + 1;
    }
}

// The numbers at the beginning of a text.
template <size_t N> std::array<float, N> leading_numbers(const std::string &text) {
    std::array<float, N> values{};
    char *at = const_cast<char *>(text.c_str());
    for (float &value : values) value = std::strtof(at, &at);
    return values;
}

Vec3 three_numbers(const std::string &text) {
    const auto v = leading_numbers<3>(text);
    return {v[0], v[1], v[2]};
}

std::map<std::string, Material> load_mtl(const std::string &path) {
    std::map<std::string, Material> materials;
    Material *current = nullptr;
    each_line(read_file(path), [&](const std::string &keyword, const std::string &rest) {
        if (keyword == "newmtl") current = &materials[rest];
        if (!current) return;
        if (keyword == "Ke") current->emission = three_numbers(rest);
        if (keyword == "Kd") {
            current->albedo = three_numbers(rest);
            // No surface reflects all light, and the library refuses such a one.
            for (int c = 0; c < 3; c++) current->albedo[c] = std::min(std::max(current->albedo[c], 0.0f), 0.98f);
        }
    });
    return materials;
}

class ObjReader {
public:
    explicit ObjReader(const std::string &path) : path(path) {
        scene.materials.emplace_back(); // of faces before the first usemtl
        scene.meshes.resize(2);         // without light map coordinates, and with them
        each_line(read_file(path), [&](const std::string &k, const std::string &rest) { statement(k, rest); });
        const auto empty = [](const Mesh &mesh) { return mesh.indices.empty(); };
        scene.meshes.erase(std::remove_if(scene.meshes.begin(), scene.meshes.end(), empty), scene.meshes.end());
    }

    SceneFile scene;

private:
    void statement(const std::string &keyword, const std::string &rest) {
        if (keyword == "v") {
            positions.push_back(leading_numbers<3>(rest));
        } else if (keyword == "vt") {
            uvs.push_back(leading_numbers<2>(rest));
        } else if (keyword == "f") {
            face(rest);
        } else if (keyword == "usemtl") {
            use_material(rest);
        } else if (keyword == "mtllib") {
            const size_t slash = path.find_last_of("/\\");
            library = load_mtl((slash == std::string::npos ? "" : path.substr(0, slash + 1)) + rest);
        }
    }

    // Of `NAME|lmN` the texture coordinates are light map coordinates on page N, which is how game
    // levels with light maps of their own are exported; if N is negative there are none.
    void use_material(const std::string &name) {
        const size_t bar = name.rfind("|lm");
        const int number = bar == std::string::npos ? -1 : std::atoi(name.c_str() + bar + 3);
        has_page = number >= 0;
        page = has_page ? uint32_t(number) : 0;
        const auto known = ids.find(name);
        if (known != ids.end()) {
            material = known->second;
            return;
        }
        auto found = library.find(name);
        if (found == library.end()) found = library.find(name.substr(0, bar));
        material = ids[name] = uint32_t(scene.materials.size());
        scene.materials.push_back(found == library.end() ? Material() : found->second);
    }

    // An index counts from 1, or back from the end if it is negative.
    size_t index(long number, size_t count) const {
        const long i = number < 0 ? long(count) + number : number - 1;
        if (i < 0 || size_t(i) >= count) fail(path, "a face names " + std::to_string(number) + ", which is not there");
        return size_t(i);
    }

    // Corners `v`, `v/vt`, `v//vn` or `v/vt/vn`. Normals are left out: the light is that of flat triangles.
    void face(const std::string &text) {
        struct Corner {
            size_t position, uv;
        };
        std::vector<Corner> corners;
        bool mapped = has_page;
        for (const char *at = text.c_str(); *at;) {
            char *end;
            Corner corner{index(std::strtol(at, &end, 10), positions.size()), 0};
            const bool has_uv = end[0] == '/' && end[1] != '/';
            mapped &= has_uv;
            if (mapped) corner.uv = index(std::strtol(end + 1, &end, 10), uvs.size());
            corners.push_back(corner);
            at = end + std::strcspn(end, " \t");
            at += std::strspn(at, " \t");
        }
        Mesh &mesh = scene.meshes[mapped];
        const auto vertex = [&](const Corner &c) {
            const uint64_t key = uint64_t(c.position) << 32 | (mapped ? c.uv : 0);
            const auto [entry, is_new] = vertices[mapped].try_emplace(key, uint32_t(mesh.positions.size() / 3));
            if (is_new) {
                mesh.positions.insert(mesh.positions.end(), positions[c.position].begin(), positions[c.position].end());
                if (mapped) mesh.lightmap_uvs.insert(mesh.lightmap_uvs.end(), uvs[c.uv].begin(), uvs[c.uv].end());
            }
            return entry->second;
        };
        for (size_t i = 2; i < corners.size(); i++) {
            mesh.indices.insert(mesh.indices.end(), {vertex(corners[0]), vertex(corners[i - 1]), vertex(corners[i])});
            mesh.materials.push_back(material);
            if (mapped) mesh.pages.push_back(page);
        }
    }

    const std::string path;
    std::vector<std::array<float, 3>> positions;
    std::vector<std::array<float, 2>> uvs;
    std::map<std::string, Material> library;
    std::map<std::string, uint32_t> ids;
    std::unordered_map<uint64_t, uint32_t> vertices[2];
    uint32_t material = 0, page = 0;
    bool has_page = false;
};

// The kind that scanners and exporters write most: little-endian, vertices that begin with float x y z
// and have only floats, then faces with nothing but a list of uchar and int. All is grey.
SceneFile load_ply(const std::string &path) {
    const std::string text = read_file(path);
    size_t vertices = 0, floats = 0, faces = 0, at = 0;
    bool in_vertices = false, understood = text.compare(0, 4, "ply\n") == 0;
    for (std::string line; line != "end_header";) {
        const size_t end = text.find('\n', at);
        if (end == std::string::npos) fail(path, "the header has no end");
        line = text.substr(at, end - at);
        at = end + 1;
        std::istringstream words(line);
        std::string keyword, kind, count;
        words >> keyword >> kind >> count;
        if (keyword == "format") understood &= kind == "binary_little_endian";
        if (keyword == "element") {
            in_vertices = kind == "vertex";
            understood &= in_vertices ? faces == 0 : kind == "face" && vertices > 0;
            (in_vertices ? vertices : faces) = std::strtoull(count.c_str(), nullptr, 10);
        }
        if (keyword == "property" && in_vertices) {
            understood &= kind == "float" && (floats > 2 || count == std::string(1, "xyz"[floats]));
            floats++;
        }
        if (keyword == "property" && !in_vertices) understood &= line.compare(0, 24, "property list uchar int ") == 0;
    }
    if (!understood || floats < 3) fail(path, "is a kind of PLY that the viewer does not read");

    SceneFile scene{{Material()}, std::vector<Mesh>(1)};
    Mesh &mesh = scene.meshes[0];
    const auto take = [&](void *to, size_t bytes) {
        if (text.size() - at < bytes) fail(path, "ends too early");
        std::memcpy(to, &text[at], bytes);
        at += bytes;
    };
    for (size_t v = 0; v < vertices; v++) {
        float p[3];
        take(p, sizeof p);
        at = std::min(at + 4 * (floats - 3), text.size());
        mesh.positions.insert(mesh.positions.end(), p, p + 3);
    }
    for (size_t f = 0; f < faces; f++) {
        uint8_t corners;
        uint32_t corner[255];
        take(&corners, 1);
        take(corner, 4 * size_t(corners));
        for (int i = 2; i < corners; i++) {
            mesh.indices.insert(mesh.indices.end(), {corner[0], corner[i - 1], corner[i]});
        }
    }
    mesh.materials.resize(mesh.indices.size() / 3);
    return scene;
}

} // namespace

bool is_scene_file(const std::string &path) { return ends_with(path, ".obj") || ends_with(path, ".ply"); }

SceneFile load_scene_file(const std::string &path) {
    return ends_with(path, ".ply") ? load_ply(path) : ObjReader(path).scene;
}
