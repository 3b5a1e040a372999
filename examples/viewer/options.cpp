#include "options.h"

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <sstream>
#include <stdexcept>

namespace {

const char HELP[] = R"(Walks through a scene while its light map gets better.

Usage: viewer SCENE [OPTIONS]

SCENE is a .obj (with its .mtl) or a binary .ply, or, drawn without the colours of
its materials, a .gltf, a .glb or a built-in scene (atrium, cornell, furnace).

Light:
  --light point:X,Y,Z:R,G,B      intensity in W/sr; may be repeated
  --light sun:DX,DY,DZ:R,G,B     direction of travel, irradiance in W/m2; likewise
  --texels-per-unit F            density of the light map; 0: the library's choice [0]
  --page-size N                  texels along a page [1024]
  --mode view|position|off       where the light map gets better [view]
  --budget-ms F                  time for that per frame [4]
  --threads N                    threads of the library; 0: one per core [0]
  --switch-light-at FRAME        switches the first light off
Picture:
  --camera PX,PY,PZ:TX,TY,TZ[:FOV]  position, target, vertical degrees [60]
  --up x|y|z                     up axis of the scene [y]
  --width N --height N           size of the picture [960 x 540]
  --exposure F                   0: from what is seen [0]
  --shadow-maps --heat-map --no-overlay  how to begin
Without a person:
  --path FILE                    lines `seconds px py pz tx ty tz` that the camera follows
  --headless                     no visible window; needs --frames
  --frames N                     ends after so many frames; 0: does not [0]
  --realtime                     by the clock; without it headless frames are 1/30 s apart
  --screenshot-every N           writes frameNNNNN.png
  --screenshot-at S,S,...        writes atS.png so many seconds after the first lit frame
  --csv FILE                     one line of figures per frame
  --out DIR                      folder of the screenshots, which must exist [.]
  --check                        fails at the end unless the textures hold the light map

Keys: WASD, E, Q and the mouse move (shift: faster); 1 view-based, 2 position-based, 0 off;
L light, B direct light baked or by shadow maps, H heat map, O overlay, Esc.
)";

[[noreturn]] void fail(const std::string &what) { throw std::runtime_error(what); }

std::vector<std::string> split(const std::string &text, char separator) {
    std::vector<std::string> parts;
    std::stringstream stream(text);
    for (std::string part; std::getline(stream, part, separator);) parts.push_back(part);
    return parts;
}

double number(const std::string &flag, const std::string &text, double least, double most) {
    char *end;
    const double value = std::strtod(text.c_str(), &end);
    if (text.empty() || *end || !(value >= least && value <= most)) {
        std::ostringstream what;
        what << flag << ": \"" << text << "\" is no number from " << least << " to " << most;
        fail(what.str());
    }
    return value;
}

Vec3 vector(const std::string &flag, const std::string &text) {
    const std::vector<std::string> parts = split(text, ',');
    if (parts.size() != 3) fail(flag + ": \"" + text + "\" is not three numbers");
    Vec3 v;
    for (int i = 0; i < 3; i++) v[i] = float(number(flag, parts[i], -1e12, 1e12));
    return v;
}

std::vector<double> seconds(const std::string &flag, const std::string &text) {
    std::vector<double> times;
    for (const std::string &part : split(text, ',')) times.push_back(number(flag, part, 0, 1e9));
    std::sort(times.begin(), times.end());
    return times;
}

PlacedLight light(const std::string &text) {
    const std::vector<std::string> parts = split(text, ':');
    if (parts.size() != 3 || (parts[0] != "point" && parts[0] != "sun")) {
        fail("--light: \"" + text + "\" is neither point:X,Y,Z:R,G,B nor sun:DX,DY,DZ:R,G,B");
    }
    return {parts[0] == "sun", vector("--light", parts[1]), vector("--light", parts[2])};
}

View camera(const std::string &text) {
    const std::vector<std::string> parts = split(text, ':');
    if (parts.size() != 2 && parts.size() != 3) fail("--camera: \"" + text + "\" is not PX,PY,PZ:TX,TY,TZ[:FOV]");
    View view{vector("--camera", parts[0]), vector("--camera", parts[1])};
    if (length(view.target - view.position) == 0) fail("--camera: \"" + text + "\" looks nowhere");
    if (parts.size() == 3) view.fov = float(number("--camera", parts[2], 1, 170));
    return view;
}

// The place of the text among the choices.
int choice(const std::string &flag, const std::string &text, const std::vector<std::string> &choices) {
    const auto found = std::find(choices.begin(), choices.end(), text);
    if (found == choices.end()) fail(flag + ": there is no \"" + text + "\"; see --help");
    return int(found - choices.begin());
}

} // namespace

Options parse_options(int argc, char **argv) {
    Options o;
    for (int i = 1; i < argc; i++) {
        const std::string flag = argv[i];
        const auto value = [&]() -> std::string {
            if (++i == argc) fail(flag + " wants a value; see --help");
            return argv[i];
        };
        const auto in = [&](double least, double most) { return number(flag, value(), least, most); };
        if (flag == "--help") {
            std::fputs(HELP, stdout);
            std::exit(0);
        } else if (flag == "--light") o.lights.push_back(light(value()));
        else if (flag == "--texels-per-unit") o.texels_per_unit = float(in(0, 1e6));
        else if (flag == "--page-size") o.page_size = uint32_t(in(16, 16384));
        else if (flag == "--mode") o.mode = Mode(choice(flag, value(), {"view", "position", "off"}));
        else if (flag == "--budget-ms") o.budget_ms = float(in(0, 1e6));
        else if (flag == "--threads") o.threads = uint32_t(in(0, 4096));
        else if (flag == "--switch-light-at") o.switch_light_at = long(in(0, 1e9));
        else if (flag == "--camera") o.camera = camera(value());
        else if (flag == "--up") o.up = choice(flag, value(), {"x", "y", "z"});
        else if (flag == "--width") o.width = int(in(16, 16384));
        else if (flag == "--height") o.height = int(in(16, 16384));
        else if (flag == "--exposure") o.exposure = float(in(0, 1e12));
        else if (flag == "--shadow-maps") o.shadow_maps = true;
        else if (flag == "--heat-map") o.heat_map = true;
        else if (flag == "--no-overlay") o.overlay = false;
        else if (flag == "--path") o.path = value();
        else if (flag == "--headless") o.headless = true;
        else if (flag == "--frames") o.frames = long(in(0, 1e9));
        else if (flag == "--realtime") o.realtime = true;
        else if (flag == "--screenshot-every") o.screenshot_every = long(in(0, 1e9));
        else if (flag == "--screenshot-at") o.screenshot_at = seconds(flag, value());
        else if (flag == "--check") o.check = true;
        else if (flag == "--csv") o.csv = value();
        else if (flag == "--out") o.out = value();
        else if (flag[0] == '-' || !o.scene.empty()) fail("\"" + flag + "\" is not understood; see --help");
        else o.scene = flag;
    }
    if (o.scene.empty()) fail("which scene? See --help");
    if (o.headless && o.frames == 0) fail("--headless needs --frames");
    return o;
}

Path::Path(const std::string &file) {
    std::ifstream in(file);
    if (!in) fail("--path: " + file + " cannot be read");
    for (std::string line; std::getline(in, line);) {
        if (line.empty() || line[0] == '#') continue;
        Key k;
        Vec3 &p = k.view.position, &t = k.view.target;
        if (!(std::istringstream(line) >> k.seconds >> p.x >> p.y >> p.z >> t.x >> t.y >> t.z) ||
            (!keys.empty() && k.seconds <= keys.back().seconds)) {
            fail("--path: " + file + ": \"" + line + "\" is not `seconds px py pz tx ty tz` with rising seconds");
        }
        keys.push_back(k);
    }
    if (keys.empty()) fail("--path: " + file + " is empty");
}

View Path::at(double seconds) const {
    const auto next = std::find_if(keys.begin(), keys.end(), [&](const Key &k) { return k.seconds > seconds; });
    if (next == keys.begin()) return keys.front().view;
    if (next == keys.end()) return keys.back().view;
    const Key &a = next[-1], &b = *next;
    const float f = float((seconds - a.seconds) / (b.seconds - a.seconds));
    return {a.view.position + f * (b.view.position - a.view.position),
            a.view.target + f * (b.view.target - a.view.target), a.view.fov};
}
