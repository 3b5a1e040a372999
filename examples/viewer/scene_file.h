// Scene files as the viewer needs them: triangles for the library, colours for the pictures.
#pragma once

#include "vec.h"

#include <cstdint>
#include <string>
#include <vector>

struct Material {
    Vec3 albedo{0.5f, 0.5f, 0.5f};
    Vec3 emission;
};

struct Mesh {
    std::vector<float> positions;    // three per vertex
    std::vector<float> lightmap_uvs; // two per vertex, or none
    std::vector<uint32_t> indices;   // three per triangle
    std::vector<uint32_t> materials; // one per triangle
    std::vector<uint32_t> pages;     // one per triangle, with lightmap_uvs
};

struct SceneFile {
    std::vector<Material> materials;
    std::vector<Mesh> meshes;
};

// Whether load_scene_file reads this kind of file.
bool is_scene_file(const std::string &path);

// Reads a .obj or a binary .ply; throws what is wrong with it.
SceneFile load_scene_file(const std::string &path);
