// Draws the scene with its light map.
#pragma once

#include "shadows.h"

#include <optional>

// Which picture.
struct Look {
    bool direct_from_shadow_maps = false; // the light map then holds indirect light alone
    bool heat_map = false;                // LODs of cells in colours
};

class Renderer {
public:
    // exposure 0: from the first picture.
    Renderer(const LiveLight &light, int width, int height, float exposure);

    // New texels of the light map, four half floats each.
    void upload(const bk_rect &rect, const void *texels);
    // All pages as they were uploaded, one after the other.
    std::vector<uint16_t> uploaded() const;
    // Into the framebuffer, which may be 0, the window's.
    void draw(const bk_camera &camera, const Look &look, GLuint framebuffer);
    void resize(int width, int height);

private:
    void load_triangles();
    void draw_triangles() const;
    void set_cells() const;
    void expose();

    const LiveLight &light;
    gl::Program scene, tone;
    GLuint vertices = 0, nothing = 0; // vertex arrays
    GLsizei vertex_count = 0;
    GLuint pages, materials, cells, linear, depth, framebuffer = 0; // textures, and what linear and depth belong to
    std::optional<Shadows> shadows;
    int width = 0, height = 0;
    float exposure;
};
