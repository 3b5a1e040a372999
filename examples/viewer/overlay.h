// Lines of text over the picture.
#pragma once

#include "gl.h"
#include "vec.h"

#include <string>
#include <vector>

class Overlay {
public:
    Overlay();
    // Adds a line below those that are there. Small letters are shown as capitals, what is not ASCII as "?".
    void print(const std::string &text, Vec3 color = {1, 1, 1});
    // Draws the lines into the current framebuffer and forgets them.
    void draw(int width, int height);

private:
    gl::Program program;
    GLuint font, array, buffer;
    std::vector<float> corners; // x, y in font pixels, u, v, r, g, b
    int lines = 0;
};
