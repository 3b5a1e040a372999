#include "shadows.h"

#include <algorithm>

const char Shadows::SHADER[] = R"(
uniform sampler2DArrayShadow shadow_maps;
uniform mat4 maps[48];
uniform int light_count;
uniform vec4 light_places[8];
uniform vec4 light_colors[8];
uniform ivec2 light_maps[8];

float lit(vec3 p, vec3 n, int light)
{
    for (int m = light_maps[light].x; m < light_maps[light].y; m++) {
        // A texel is as wide as the surface that it stands for; the point is raised by that, or the
        // surface would shadow itself.
        float width = light_colors[light].w * (maps[m] * vec4(p, 1)).w;
        vec4 q = maps[m] * vec4(p + 1.5 * width * n, 1);
        if (q.w > 0 && max(abs(q.x), abs(q.y)) <= q.w) {
            q.xyz = 0.5 + 0.5 * q.xyz / q.w;
            return texture(shadow_maps, vec4(q.xy, m, q.z));
        }
    }
    return 1.0;
}

vec3 direct(vec3 p, vec3 n)
{
    vec3 e = vec3(0);
    for (int i = 0; i < light_count; i++) {
        bool sun = light_places[i].w == 0;
        vec3 to_light = sun ? -light_places[i].xyz : light_places[i].xyz - p;
        float cosine = dot(n, normalize(to_light));
        if (cosine > 0)
            e += light_colors[i].rgb * (cosine / (sun ? 1.0 : dot(to_light, to_light)) * lit(p, n, i));
    }
    return e;
}
)";

Shadows::Shadows(const LiveLight &light, const std::function<void()> &draw) {
    const Vec3 middle = 0.5f * (light.lower + light.upper);
    const float radius = 0.51f * length(light.upper - light.lower);
    for (const PlacedLight &l : light.lights) {
        if (ranges.size() < 2 * LIGHTS) add_light(l, middle, radius);
    }
    if (maps.empty()) return;

    texture = gl::make_texture(GL_TEXTURE_2D_ARRAY, GL_LINEAR);
    gl::allocate(GL_TEXTURE_2D_ARRAY, GL_DEPTH_COMPONENT24, SIZE, SIZE, int(maps.size()), GL_DEPTH_COMPONENT,
                 GL_UNSIGNED_INT, nullptr);
    gl::TexParameteri(GL_TEXTURE_2D_ARRAY, GL_TEXTURE_COMPARE_MODE, GL_COMPARE_REF_TO_TEXTURE);
    GLuint framebuffer;
    gl::GenFramebuffers(1, &framebuffer);
    gl::BindFramebuffer(GL_FRAMEBUFFER, framebuffer);
    gl::DrawBuffer(GL_NONE);
    gl::ReadBuffer(GL_NONE);
    gl::Viewport(0, 0, SIZE, SIZE);
    gl::ClearDepth(1);
    gl::DepthFunc(GL_LESS);
    gl::Enable(GL_POLYGON_OFFSET_FILL);
    gl::PolygonOffset(2, 4);
    const gl::Program program("#version 330 core\n"
                              "layout(location = 0) in vec3 position;"
                              "uniform mat4 map;"
                              "void main() { gl_Position = map * vec4(position, 1); }",
                              "#version 330 core\n"
                              "void main() {}");
    program.use();
    for (size_t m = 0; m < maps.size(); m++) {
        gl::FramebufferTextureLayer(GL_FRAMEBUFFER, GL_DEPTH_ATTACHMENT, texture, 0, GLint(m));
        gl::Clear(GL_DEPTH_BUFFER_BIT);
        gl::UniformMatrix4fv(program["map"], 1, GL_FALSE, maps[m].data());
        draw();
    }
    gl::Disable(GL_POLYGON_OFFSET_FILL);
}

void Shadows::add_light(const PlacedLight &light, Vec3 middle, float radius) {
    const auto across = [](Vec3 v) { return std::abs(v.x) < std::abs(v.y) ? Vec3{1, 0, 0} : Vec3{0, 1, 0}; };
    ranges.push_back(GLint(maps.size()));
    float width = 2; // of the whole map
    const float distance = length(middle - light.place);
    if (light.sun) {
        const Vec3 d = normalize(light.place);
        maps.push_back(orthographic(radius, 0, 2 * radius) * look_at(middle - radius * d, d, across(d)));
        width = 2 * radius;
    } else if (distance > 1.3f * radius) {
        const Vec3 d = middle - light.place;
        const float half_angle = std::asin(radius / distance);
        maps.push_back(perspective(2 * half_angle, 1, distance - radius, distance + radius) *
                       look_at(light.place, d, across(d)));
        width = 2 * std::tan(half_angle);
    } else {
        for (int face = 0; face < 6; face++) {
            Vec3 d;
            d[face / 2] = face % 2 ? 1.0f : -1.0f;
            // A little more than a right angle, so that filtering sees beyond the edges of the cube.
            maps.push_back(perspective(1.58f, 1, 1e-3f * radius, distance + radius) *
                           look_at(light.place, d, across(d)));
        }
    }
    ranges.push_back(GLint(maps.size()));
    places.insert(places.end(), {light.place.x, light.place.y, light.place.z, light.sun ? 0.0f : 1.0f});
    colors.insert(colors.end(), {light.color.x, light.color.y, light.color.z, width / SIZE});
}

void Shadows::set(const gl::Program &program, int unit, bool first_is_off) const {
    const auto count = GLsizei(ranges.size() / 2);
    std::vector<float> shown = colors;
    if (first_is_off) std::fill_n(shown.begin(), 3, 0.0f);
    gl::bind_texture(unit, GL_TEXTURE_2D_ARRAY, texture);
    gl::Uniform1i(program["light_count"], count);
    if (count == 0) return;
    gl::UniformMatrix4fv(program["maps"], GLsizei(maps.size()), GL_FALSE, maps[0].data());
    gl::Uniform4fv(program["light_places"], count, places.data());
    gl::Uniform4fv(program["light_colors"], count, shown.data());
    gl::Uniform2iv(program["light_maps"], count, ranges.data());
}
