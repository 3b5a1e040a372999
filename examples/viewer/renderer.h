// Draws the scene with its light map.
#pragma once

#include "shadows.h"

#include <optional>

// Which picture.
struct Look {
    bool direct_from_shadow_maps = false; // the light map then holds indirect light alone
    bool heat_map = false;                // LODs of cells in colours
    bool find_exposure = true;            // from this picture, unless one was given
};

class Renderer {
public:
    // exposure 0: from the pictures.
    Renderer(const LiveLight &light, int width, int height, float exposure);

    // New texels of the light map, four half floats each.
    void upload(const bk_rect &rect, const void *texels);
    // All pages as they were uploaded, one after the other.
    std::vector<uint16_t> uploaded() const;
    // Into the framebuffer, which may be 0, the window's.
    void draw(const bk_camera &camera, const Look &look, GLuint framebuffer);
    void set_size(int width, int height);
    // Whether the last picture from which exposure was to be found had no light in it.
    bool shows_nothing() const { return is_dark; }

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
    bool given_exposure, is_dark = false;
    float exposure;
};
