// Shadow maps of point lights and suns, for direct light in the shader.
#pragma once

#include "gl.h"
#include "live_light.h"

// One square map per direction that a light shines in: a sun has one, a point light amid the scene six,
// like the faces of a cube, and one far from it has one again, aimed at the scene. All maps are layers
// of one texture. Scene and lights do not move, so each is drawn once.
class Shadows {
public:
    static constexpr int LIGHTS = 8, SIZE = 1024;

    // draw() draws the scene's triangles, whose positions are attribute 0. Lights beyond LIGHTS, and
    // those that files bring, cast no light in the shader.
    Shadows(const LiveLight &light, const std::function<void()> &draw);

    // Sets the uniforms of SHADER in a program that is in use.
    void set(const gl::Program &program, int unit, bool first_is_off) const;

    // vec3 direct(vec3 p, vec3 n): irradiance at p, on the side of n.
    static const char SHADER[];

private:
    void add_light(const PlacedLight &light, Vec3 middle, float radius);

    GLuint texture = 0;
    std::vector<Mat4> maps;      // from the scene to each map
    std::vector<float> places;   // of each light x y z, and 0 for a sun or 1
    std::vector<float> colors;   // of each light r g b, and the width of a texel (at distance 1 of a point light)
    std::vector<GLint> ranges;   // of each light its first map, and one behind its last
};
