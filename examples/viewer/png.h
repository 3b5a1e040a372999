// Writes PNG files.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

// rgb: three bytes per pixel, the lowest row first, as OpenGL reads it. Throws if it cannot be written.
void write_png(const std::string &path, int width, int height, const std::vector<uint8_t> &rgb);
