#include "renderer.h"

#include <cstddef>
#include <stdexcept>
#include <string>

namespace {

// Texture units.
enum { PAGES, MATERIALS, SHADOWS, CELLS, LINEAR };

struct Vertex {
    float position[3];
    float uv[2], back_uv[2];
    uint16_t page, back_page, material;
};

const char SCENE_VERTEX[] = R"(#version 330 core
layout(location = 0) in vec3 position;
layout(location = 1) in vec4 lightmap_uvs;
layout(location = 2) in ivec3 numbers;
uniform mat4 camera;
out vec3 world;
out vec2 uv, back_uv;
flat out int page, back_page, material;

void main()
{
    world = position;
    uv = lightmap_uvs.xy, back_uv = lightmap_uvs.zw;
    page = numbers.x, back_page = numbers.y, material = numbers.z;
    gl_Position = camera * vec4(position, 1);
}
)";

const char SCENE_FRAGMENT_BEGIN[] = R"(#version 330 core
in vec3 world;
in vec2 uv, back_uv;
flat in int page, back_page, material;
out vec4 color;
uniform sampler2DArray pages;
uniform sampler2D materials;
uniform usampler3D cells;
uniform bool shade_direct, heat;
uniform float near;
uniform vec3 cell_origin;
uniform float cell_size;
)";

// Surfaces are diffuse: what leaves them is albedo / pi times the irradiance, which is what light maps hold.
// Alpha tells the next pass the LOD.
const char SCENE_FRAGMENT_END[] = R"(
void main()
{
    vec3 normal = normalize(cross(dFdx(world), dFdy(world))); // of the side that is seen
    vec3 irradiance = texture(pages, gl_FrontFacing ? vec3(uv, page) : vec3(back_uv, back_page)).rgb;
    if (shade_direct) irradiance += direct(world, normal);
    vec3 albedo = texelFetch(materials, ivec2(0, material), 0).rgb;
    color.rgb = albedo / 3.14159265 * irradiance + texelFetch(materials, ivec2(1, material), 0).rgb;
    color.a = 0;
    // The inverse of the distance, which floats hold best where surfaces lie a hair apart far away.
    gl_FragDepth = near * gl_FragCoord.w;
    if (heat) {
        ivec3 cell = clamp(ivec3((world - cell_origin) / cell_size), ivec3(0), textureSize(cells, 0) - 1);
        uint lod = texelFetch(cells, cell, 0).r;
        if (lod < 4u) color.a = float(lod + 1u);
    }
}
)";

const char TONE_VERTEX[] = R"(#version 330 core
void main() { gl_Position = vec4(4 * (gl_VertexID % 2) - 1, 4 * (gl_VertexID / 2) - 1, 0, 1); }
)";

const char TONE_FRAGMENT[] = R"(#version 330 core
out vec4 color;
uniform sampler2D picture;
uniform float exposure;
const vec3 heat[4] = vec3[](vec3(0.9, 0.1, 0.1), vec3(0.9, 0.7, 0), vec3(0.1, 0.7, 0.2), vec3(0.1, 0.4, 1));

void main()
{
    vec4 p = texelFetch(picture, ivec2(gl_FragCoord.xy), 0);
    color = vec4(pow(1 - exp(-exposure * p.rgb), vec3(1 / 2.2)), 1);
    if (p.a > 0.5) color.rgb = mix(color.rgb, heat[int(p.a - 0.5)], 0.4);
}
)";

} // namespace

Renderer::Renderer(const LiveLight &light, int width, int height, float exposure)
    : light(light),
      scene(SCENE_VERTEX, (std::string(SCENE_FRAGMENT_BEGIN) + Shadows::SHADER + SCENE_FRAGMENT_END).c_str()),
      tone(TONE_VERTEX, TONE_FRAGMENT), given_exposure(exposure > 0), exposure(exposure) {
    load_triangles();
    gl::GenVertexArrays(1, &nothing);

    GLint most_pages;
    gl::GetIntegerv(GL_MAX_ARRAY_TEXTURE_LAYERS, &most_pages);
    if (light.pages.page_count > uint32_t(most_pages)) {
        throw std::runtime_error("the light map has " + std::to_string(light.pages.page_count) +
                                 " pages and OpenGL room for " + std::to_string(most_pages) +
                                 "; give a larger --page-size");
    }
    // Filtering reads one texel beyond a chart, which its padding has; mip maps would want more.
    pages = gl::make_texture(GL_TEXTURE_2D_ARRAY, GL_LINEAR);
    gl::allocate(GL_TEXTURE_2D_ARRAY, GL_RGBA16F, int(light.pages.width), int(light.pages.height),
                 int(light.pages.page_count), GL_RGBA, GL_HALF_FLOAT, nullptr);
    materials = gl::make_texture(GL_TEXTURE_2D, GL_NEAREST);
    gl::allocate(GL_TEXTURE_2D, GL_RGB32F, 2, int(light.materials.size()), 0, GL_RGB, GL_FLOAT, light.materials.data());
    cells = gl::make_texture(GL_TEXTURE_3D, GL_NEAREST);
    linear = gl::make_texture(GL_TEXTURE_2D, GL_NEAREST);
    depth = gl::make_texture(GL_TEXTURE_2D, GL_NEAREST);
    gl::GenFramebuffers(1, &framebuffer);
    set_size(width, height);

    gl::PixelStorei(GL_UNPACK_ALIGNMENT, 1);
    gl::PixelStorei(GL_PACK_ALIGNMENT, 1);
    scene.use();
    gl::Uniform1i(scene["pages"], PAGES);
    gl::Uniform1i(scene["materials"], MATERIALS);
    gl::Uniform1i(scene["shadow_maps"], SHADOWS);
    gl::Uniform1i(scene["cells"], CELLS);
    tone.use();
    gl::Uniform1i(tone["picture"], LINEAR);
}

// Corners of neighbouring triangles may lie apart in the light map, so each triangle has its own three.
void Renderer::load_triangles() {
    std::vector<Vertex> corners;
    std::vector<float> uvs, back_uvs;
    std::vector<uint32_t> page, back_page;
    for (uint32_t m = 0; m < light.mesh_count(); m++) {
        const bk_mesh_view mesh = light.geometry(m);
        const std::vector<uint32_t> &material = light.triangle_materials(m);
        light.layout(m, uvs, page);
        light.layout_of_backs(m, back_uvs, back_page);
        for (size_t t = 0; t < mesh.triangle_count; t++) {
            if (page[t] == BK_NONE) continue; // degenerate
            for (size_t c = 3 * t; c < 3 * t + 3; c++) {
                const float *p = mesh.positions + 3 * size_t(mesh.indices[c]);
                corners.push_back({{p[0], p[1], p[2]}, {uvs[2 * c], uvs[2 * c + 1]},
                                   {back_uvs[2 * c], back_uvs[2 * c + 1]}, uint16_t(page[t]), uint16_t(back_page[t]),
                                   uint16_t(material.empty() ? 0 : material[t])});
            }
        }
    }
    vertex_count = GLsizei(corners.size());
    GLuint buffer;
    gl::GenVertexArrays(1, &vertices);
    gl::BindVertexArray(vertices);
    gl::GenBuffers(1, &buffer);
    gl::BindBuffer(GL_ARRAY_BUFFER, buffer);
    gl::BufferData(GL_ARRAY_BUFFER, GLsizeiptr(corners.size() * sizeof(Vertex)), corners.data(), GL_STATIC_DRAW);
    const auto offset = [](size_t bytes) { return reinterpret_cast<const void *>(bytes); };
    gl::VertexAttribPointer(0, 3, GL_FLOAT, GL_FALSE, sizeof(Vertex), offset(offsetof(Vertex, position)));
    gl::VertexAttribPointer(1, 4, GL_FLOAT, GL_FALSE, sizeof(Vertex), offset(offsetof(Vertex, uv)));
    gl::VertexAttribIPointer(2, 3, GL_UNSIGNED_SHORT, sizeof(Vertex), offset(offsetof(Vertex, page)));
    for (GLuint attribute = 0; attribute < 3; attribute++) gl::EnableVertexAttribArray(attribute);
}

void Renderer::set_size(int new_width, int new_height) {
    width = new_width, height = new_height;
    gl::bind_texture(LINEAR, GL_TEXTURE_2D, depth);
    gl::allocate(GL_TEXTURE_2D, GL_DEPTH_COMPONENT32F, width, height, 0, GL_DEPTH_COMPONENT, GL_FLOAT, nullptr);
    gl::bind_texture(LINEAR, GL_TEXTURE_2D, linear);
    gl::allocate(GL_TEXTURE_2D, GL_RGBA16F, width, height, 0, GL_RGBA, GL_FLOAT, nullptr);
    gl::BindFramebuffer(GL_FRAMEBUFFER, framebuffer);
    gl::FramebufferTexture2D(GL_FRAMEBUFFER, GL_COLOR_ATTACHMENT0, GL_TEXTURE_2D, linear, 0);
    gl::FramebufferTexture2D(GL_FRAMEBUFFER, GL_DEPTH_ATTACHMENT, GL_TEXTURE_2D, depth, 0);
    if (gl::CheckFramebufferStatus(GL_FRAMEBUFFER) != GL_FRAMEBUFFER_COMPLETE) {
        throw std::runtime_error("OpenGL cannot draw to half floats");
    }
}

void Renderer::upload(const bk_rect &rect, const void *texels) {
    gl::bind_texture(PAGES, GL_TEXTURE_2D_ARRAY, pages);
    gl::TexSubImage3D(GL_TEXTURE_2D_ARRAY, 0, GLint(rect.x), GLint(rect.y), GLint(rect.page), GLsizei(rect.width),
                      GLsizei(rect.height), 1, GL_RGBA, GL_HALF_FLOAT, texels);
}

std::vector<uint16_t> Renderer::uploaded() const {
    std::vector<uint16_t> halves(size_t(light.pages.width) * light.pages.height * light.pages.page_count * 4);
    gl::bind_texture(PAGES, GL_TEXTURE_2D_ARRAY, pages);
    gl::GetTexImage(GL_TEXTURE_2D_ARRAY, 0, GL_RGBA, GL_HALF_FLOAT, halves.data());
    return halves;
}

void Renderer::draw_triangles() const {
    gl::BindVertexArray(vertices);
    gl::Enable(GL_DEPTH_TEST);
    gl::DrawArrays(GL_TRIANGLES, 0, vertex_count);
    gl::Disable(GL_DEPTH_TEST);
}

void Renderer::set_cells() const {
    bk_cell_info info;
    const std::vector<uint8_t> lods = light.cells(info);
    gl::bind_texture(CELLS, GL_TEXTURE_3D, cells);
    gl::allocate(GL_TEXTURE_3D, GL_R8UI, int(info.dimensions[0]), int(info.dimensions[1]), int(info.dimensions[2]),
                 GL_RED_INTEGER, GL_UNSIGNED_BYTE, lods.data());
    gl::Uniform3fv(scene["cell_origin"], 1, info.origin);
    gl::Uniform1f(scene["cell_size"], info.cell_size);
}

// So that what is seen is a medium grey on average: of roots, or lamps would count too much. The first picture jumps
// there, later ones go a part of the way, so that nobody sees a step.
void Renderer::expose() {
    std::vector<float> rgba(size_t(width) * height * 4);
    gl::ReadPixels(0, 0, width, height, GL_RGBA, GL_FLOAT, rgba.data());
    double sum = 0;
    int lit = 0;
    for (size_t i = 0; i < rgba.size(); i += 4) {
        const float luminance = 0.2126f * rgba[i] + 0.7152f * rgba[i + 1] + 0.0722f * rgba[i + 2];
        if (!(luminance > 0)) continue;
        sum += std::sqrt(luminance);
        lit++;
    }
    is_dark = lit == 0;
    if (is_dark || given_exposure) return;
    const float wanted = 0.4f / float(std::pow(sum / lit, 2));
    exposure = exposure == 0 ? wanted : exposure * std::pow(wanted / exposure, 0.3f);
}

void Renderer::draw(const bk_camera &camera, const Look &look, GLuint target) {
    if (look.direct_from_shadow_maps && !shadows) shadows.emplace(light, [this] { draw_triangles(); });

    const Vec3 eye{camera.position[0], camera.position[1], camera.position[2]};
    const float size = length(light.upper - light.lower);
    const float far = size + length(eye - 0.5f * (light.lower + light.upper));
    const float near = 5e-4f * size;
    const Mat4 matrix = perspective(camera.fov_y, float(width) / float(height), near, far) *
                        look_at(eye, {camera.forward[0], camera.forward[1], camera.forward[2]},
                                {camera.up[0], camera.up[1], camera.up[2]});
    gl::BindFramebuffer(GL_FRAMEBUFFER, framebuffer);
    gl::Viewport(0, 0, width, height);
    gl::ClearColor(0, 0, 0, 0);
    gl::ClearDepth(0); // infinitely far
    gl::DepthFunc(GL_GREATER);
    gl::Clear(GL_COLOR_BUFFER_BIT | GL_DEPTH_BUFFER_BIT);
    scene.use();
    gl::Uniform1f(scene["near"], near);
    gl::UniformMatrix4fv(scene["camera"], 1, GL_FALSE, matrix.data());
    gl::Uniform1i(scene["shade_direct"], look.direct_from_shadow_maps);
    gl::Uniform1i(scene["heat"], look.heat_map);
    gl::bind_texture(PAGES, GL_TEXTURE_2D_ARRAY, pages);
    gl::bind_texture(MATERIALS, GL_TEXTURE_2D, materials);
    if (look.heat_map) set_cells();
    if (look.direct_from_shadow_maps) shadows->set(scene, SHADOWS, light.is_switched_off());
    draw_triangles();
    if (look.find_exposure) expose();

    gl::BindFramebuffer(GL_FRAMEBUFFER, target);
    tone.use();
    gl::Uniform1f(tone["exposure"], exposure);
    gl::bind_texture(LINEAR, GL_TEXTURE_2D, linear);
    gl::BindVertexArray(nothing);
    gl::DrawArrays(GL_TRIANGLES, 0, 3);
}
