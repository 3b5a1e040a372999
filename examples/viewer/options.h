// The command line, and paths that a camera follows.
#pragma once

#include "vec.h"

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

// A light of the command line; as bakelite describes it, so that it can be switched and drawn.
struct PlacedLight {
    bool sun = false;
    Vec3 place; // of a point light its position, of the sun the direction in which the light travels
    Vec3 color; // of a point light its intensity in W/sr, of the sun W/m2
};

struct View {
    Vec3 position, target;
    float fov = 60; // vertical degrees
};

enum class Mode { view, position, off };

struct Options {
    std::string scene;
    std::vector<PlacedLight> lights;
    float texels_per_unit = 0; // 0: the library's choice
    uint32_t page_size = 1024;
    int up = 1; // axis
    std::optional<View> camera;
    Mode mode = Mode::view;
    float budget_ms = 4;
    uint32_t threads = 0; // 0: one per core
    int width = 960, height = 540;
    float exposure = 0; // 0: from what is seen
    bool shadow_maps = false, heat_map = false, overlay = true;
    bool headless = false, realtime = false, check = false;
    long frames = 0; // 0: until the window is closed
    long screenshot_every = 0, switch_light_at = -1;
    std::vector<double> screenshot_at; // rising seconds
    std::string path, csv, out = ".";
};

// Throws a sentence that names the flag and the value at fault. `--help` prints and ends the program.
Options parse_options(int argc, char **argv);

// Views over time, from lines `seconds px py pz tx ty tz`.
class Path {
public:
    explicit Path(const std::string &file);
    // Between two lines linearly; before the first and behind the last as they say.
    View at(double seconds) const;

private:
    struct Key {
        double seconds;
        View view;
    };
    std::vector<Key> keys;
};
