// Walks through a scene while bakelite makes its light map better where the camera looks: an example of
// live updates in a rasterizer.
//
//     viewer SCENE [OPTIONS]        (see --help)
//
// | file         | what                                                                   |
// |--------------|------------------------------------------------------------------------|
// | live_light   | everything that calls bakelite: start here                             |
// | renderer     | the scene with the light map's pages as textures; tone mapping         |
// | shadows      | shadow maps, for programs that shade direct light themselves           |
// | scene_file   | readers of OBJ and PLY                                                 |
// | overlay, gl, png, options, vec | text, OpenGL, screenshots, command line, vectors     |

#include "overlay.h"
#include "png.h"
#include "renderer.h"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdio>
#include <future>
#include <mutex>
#include <stdexcept>

namespace {

// Bytes of texels that a frame uploads at most.
constexpr uint64_t MAX_DIRTY_BYTES = 256 << 10;

// Time per frame to fetch and upload what has changed. What is left comes in the next frames.
constexpr double UPLOAD_MS = 3, WHATEVER_IT_TAKES = 1e6;

// Exposure follows the pictures, every so many, until what is seen errs by no more than this or so many have passed;
// then it stays, so that a light that is switched off makes the picture dark.
constexpr long EXPOSE_EVERY = 8, MOST_EXPOSED = 400;
constexpr float EXPOSE_ERROR = 0.1f;

using Clock = std::chrono::steady_clock;
const Clock::time_point program_start = Clock::now();

double seconds_since(Clock::time_point start) { return std::chrono::duration<double>(Clock::now() - start).count(); }

template <class... Values> std::string text(const char *format, Values... values) {
    char buffer[200];
    std::snprintf(buffer, sizeof buffer, format, values...);
    return buffer;
}

// The window with its OpenGL context. Headless it is never shown.
class Window {
public:
    explicit Window(const Options &options) {
        glfwSetErrorCallback([](int, const char *message) { std::fprintf(stderr, "%s\n", message); });
        if (!glfwInit()) throw std::runtime_error("there is no display; try xvfb-run");
        glfwWindowHint(GLFW_CONTEXT_VERSION_MAJOR, 3);
        glfwWindowHint(GLFW_CONTEXT_VERSION_MINOR, 3);
        glfwWindowHint(GLFW_OPENGL_PROFILE, GLFW_OPENGL_CORE_PROFILE);
        glfwWindowHint(GLFW_OPENGL_FORWARD_COMPAT, GLFW_TRUE);
        glfwWindowHint(GLFW_VISIBLE, options.headless ? GLFW_FALSE : GLFW_TRUE);
        handle = glfwCreateWindow(options.width, options.height, "bakelite", nullptr, nullptr);
        if (!handle) throw std::runtime_error("there is no OpenGL 3.3");
        glfwMakeContextCurrent(handle);
        glfwSwapInterval(options.headless ? 0 : 1);
        gl::load();
        if (!options.headless) glfwSetInputMode(handle, GLFW_CURSOR, GLFW_CURSOR_DISABLED);
    }
    ~Window() { glfwTerminate(); }
    Window(const Window &) = delete;
    Window &operator=(const Window &) = delete;

    GLFWwindow *handle = nullptr;
};

// A person's eyes: a place, and where they look in angles around and above the horizon.
class Walker {
public:
    Walker(const Options &options, Vec3 lower, Vec3 upper) : up(options.up), size(length(upper - lower)) {
        View start{0.5f * (lower + upper), {}};
        Vec3 along;
        const int a = (up + 1) % 3, b = (up + 2) % 3;
        along[upper[a] - lower[a] > upper[b] - lower[b] ? a : b] = 1;
        start.target = start.position + along;
        look(options.camera.value_or(start));
    }

    void look(const View &view) {
        position = view.position, fov = view.fov;
        const Vec3 d = normalize(view.target - view.position);
        around = std::atan2(d[(up + 2) % 3], d[(up + 1) % 3]);
        above = std::asin(std::min(std::max(d[up], -0.999f), 0.999f));
    }

    void walk(GLFWwindow *window, float seconds) {
        double x, y;
        glfwGetCursorPos(window, &x, &y);
        if (has_cursor) {
            around -= 0.003f * float(x - cursor[0]);
            above = std::min(std::max(above - 0.003f * float(y - cursor[1]), -1.5f), 1.5f);
        }
        has_cursor = true, cursor[0] = x, cursor[1] = y;

        const auto key = [window](int k) { return float(glfwGetKey(window, k) == GLFW_PRESS); };
        const float step = size / 15 * seconds * (1 + 3 * key(GLFW_KEY_LEFT_SHIFT));
        const Vec3 f = forward(), right = normalize(cross(f, up_vector()));
        position = position + step * (key(GLFW_KEY_W) - key(GLFW_KEY_S)) * f +
                   step * (key(GLFW_KEY_D) - key(GLFW_KEY_A)) * right +
                   step * (key(GLFW_KEY_E) - key(GLFW_KEY_Q)) * up_vector();
    }

    bk_camera camera(int width, int height) const {
        bk_camera camera;
        bk_camera_init(&camera);
        camera.width = uint32_t(width), camera.height = uint32_t(height);
        camera.fov_y = fov * 3.14159265f / 180;
        const Vec3 f = forward(), u = up_vector();
        for (int i = 0; i < 3; i++) camera.position[i] = position[i], camera.forward[i] = f[i], camera.up[i] = u[i];
        return camera;
    }

private:
    Vec3 up_vector() const {
        Vec3 v;
        v[up] = 1;
        return v;
    }

    Vec3 forward() const {
        Vec3 v;
        v[up] = std::sin(above);
        v[(up + 1) % 3] = std::cos(above) * std::cos(around);
        v[(up + 2) % 3] = std::cos(above) * std::sin(around);
        return v;
    }

    int up;
    float size;
    Vec3 position;
    float fov = 60, around = 0, above = 0;
    bool has_cursor = false;
    double cursor[2];
};

// Loads on a thread of its own, so that the window answers and can be closed meanwhile. Null if it was.
std::unique_ptr<LiveLight> load(const Options &options, GLFWwindow *window, Overlay &overlay) {
    std::mutex lock;
    std::string state;
    std::atomic<bool> cancelled{false};
    const Progress progress = [&](float fraction, const char *stage) {
        const std::lock_guard<std::mutex> guard(lock);
        state = text("%s %.0f %%", stage, 100.0 * double(fraction));
        return !cancelled;
    };
    auto loading = std::async(std::launch::async, [&] { return std::make_unique<LiveLight>(options, progress); });
    while (loading.wait_for(std::chrono::milliseconds(30)) != std::future_status::ready) {
        glfwPollEvents();
        cancelled = glfwWindowShouldClose(window);
        if (options.headless) continue;
        int width, height;
        glfwGetFramebufferSize(window, &width, &height);
        gl::Viewport(0, 0, width, height);
        gl::ClearColor(0, 0, 0, 1);
        gl::Clear(GL_COLOR_BUFFER_BIT);
        {
            const std::lock_guard<std::mutex> guard(lock);
            overlay.print(state);
        }
        overlay.draw(width, height);
        glfwSwapBuffers(window);
    }
    if (cancelled) {
        try {
            loading.get();
        } catch (const std::exception &) { // that it was cancelled
        }
        return nullptr;
    }
    return loading.get();
}

class Viewer {
public:
    Viewer(const Options &options, const Window &window, Overlay &overlay, LiveLight &light)
        : options(options), window(window.handle), overlay(overlay), light(light),
          walker(options, light.lower, light.upper), renderer(light, options.width, options.height, options.exposure),
          mode(options.mode), overlay_shown(options.overlay) {
        look.direct_from_shadow_maps = options.shadow_maps;
        look.heat_map = options.heat_map;
        width = options.width, height = options.height;
        if (!options.path.empty()) path.emplace(options.path);
        if (options.headless) make_target();
        if (!options.csv.empty()) open_csv();
        glfwSetWindowUserPointer(window.handle, this);
        glfwSetKeyCallback(window.handle, [](GLFWwindow *w, int key, int, int action, int) {
            if (action == GLFW_PRESS) static_cast<Viewer *>(glfwGetWindowUserPointer(w))->press(key);
        });
    }
    ~Viewer() {
        if (csv) std::fclose(csv);
    }
    Viewer(const Viewer &) = delete;
    Viewer &operator=(const Viewer &) = delete;

    void run() {
        const Clock::time_point start = Clock::now();
        for (long frame = 0; options.frames == 0 || frame < options.frames; frame++) {
            if (glfwWindowShouldClose(window)) break;
            const bool by_clock = !options.headless || options.realtime;
            const Clock::time_point frame_start = Clock::now();
            const double now = by_clock ? seconds_since(start) : double(frame) / 30;
            const double step = now - time;
            time = now;
            glfwPollEvents();
            if (frame == options.switch_light_at) switch_light();
            if (path) walker.look(with_fov(path->at(time)));
            else if (!options.headless) walker.walk(window, float(step));
            if (!options.headless) fit_window();
            const Work work = draw();
            glfwSwapBuffers(window);
            // OpenGL in software works on the cores that the next update needs.
            if (options.headless || frame == 0) gl::Finish();
            frame_ms = 1000 * seconds_since(frame_start);
            if (frame == 0) {
                std::printf("first lit frame after %.2f s\n", seconds_since(program_start));
                std::fflush(stdout);
            }
            if (csv) write_row(frame, work);
            write_screenshots(frame);
        }
        if (options.check) {
            light.changes(!look.direct_from_shadow_maps, WHATEVER_IT_TAKES,
                          [&](const bk_rect &rect, const void *data) { renderer.upload(rect, data); });
            check_textures();
        }
    }

private:
    // What a frame's light took.
    struct Work {
        bk_live_stats stats;
        double update_ms = 0, upload_ms = 0;
        size_t rects = 0, texels = 0;
    };

    void press(int key) {
        if (key == GLFW_KEY_ESCAPE) glfwSetWindowShouldClose(window, GLFW_TRUE);
        if (key == GLFW_KEY_1) set_mode(Mode::view);
        if (key == GLFW_KEY_2) set_mode(Mode::position);
        if (key == GLFW_KEY_0) set_mode(Mode::off);
        if (key == GLFW_KEY_L) switch_light();
        if (key == GLFW_KEY_H) look.heat_map = !look.heat_map;
        if (key == GLFW_KEY_O) overlay_shown = !overlay_shown;
        if (key == GLFW_KEY_B) {
            look.direct_from_shadow_maps = !look.direct_from_shadow_maps;
            all_is_new = true; // texels with direct light, or without it
        }
    }

    void switch_light() {
        light.switch_light();
        finds_exposure = renderer.shows_nothing();
    }

    void set_mode(Mode m) {
        mode = m;
        light.set_mode(m);
        is_starting = true;
    }

    // A path has no field of view of its own.
    View with_fov(View view) const {
        if (options.camera) view.fov = options.camera->fov;
        return view;
    }

    void fit_window() {
        int w, h;
        glfwGetFramebufferSize(window, &w, &h);
        if (w < 1 || h < 1 || (w == width && h == height)) return;
        width = w, height = h;
        renderer.set_size(w, h);
    }

    // Pixels of a hidden window are nobody's, so headless pictures go to a texture.
    void make_target() {
        const GLuint texture = gl::make_texture(GL_TEXTURE_2D, GL_NEAREST);
        gl::allocate(GL_TEXTURE_2D, GL_RGBA8, width, height, 0, GL_RGBA, GL_UNSIGNED_BYTE, nullptr);
        gl::GenFramebuffers(1, &target);
        gl::BindFramebuffer(GL_FRAMEBUFFER, target);
        gl::FramebufferTexture2D(GL_FRAMEBUFFER, GL_COLOR_ATTACHMENT0, GL_TEXTURE_2D, texture, 0);
    }

    // One frame: what a program with live light maps does.
    Work draw() {
        Work work;
        const bk_camera camera = walker.camera(width, height);
        const Clock::time_point update_start = Clock::now();
        // The first frame shows all there is; later ones are not held up by changes. (Checks compare all textures.)
        work.stats = light.update(camera, options.budget_ms, is_starting || options.check ? 0 : MAX_DIRTY_BYTES);
        work.update_ms = 1000 * seconds_since(update_start);

        const Clock::time_point upload_start = Clock::now();
        const auto upload = [&](const bk_rect &rect, const void *data) {
            renderer.upload(rect, data);
            work.rects++;
            work.texels += size_t(rect.width) * rect.height;
        };
        light.changes(!look.direct_from_shadow_maps, is_starting ? WHATEVER_IT_TAKES : UPLOAD_MS, upload);
        if (all_is_new) light.everything(!look.direct_from_shadow_maps, upload);
        all_is_new = is_starting = false;
        work.upload_ms = 1000 * seconds_since(upload_start);

        look.find_exposure = finds_exposure && pictures % EXPOSE_EVERY == 0;
        renderer.draw(camera, look, target);
        // Without light there is no error either.
        const bool is_settled = !renderer.shows_nothing() && work.stats.visible_error < EXPOSE_ERROR;
        if (pictures++ > 0 && look.find_exposure) finds_exposure = !is_settled && pictures < MOST_EXPOSED;
        if (overlay_shown) {
            print(work);
            overlay.draw(width, height);
        }
        return work;
    }

    void open_csv() {
        csv = std::fopen(options.csv.c_str(), "w");
        if (!csv) throw std::runtime_error(options.csv + " cannot be written");
        // `seconds` since the program began, `time` since the first lit frame as the path counts it.
        std::fputs("frame,seconds,time,frame_ms,update_ms,upload_ms,budget_ms,rays,visible_error,", csv);
        std::fputs("visible_finished,finished,dirty_rects,dirty_bytes,cells_promoted,bytes,light_pending\n", csv);
    }

    void write_row(long frame, const Work &work) const {
        const bk_live_stats &s = work.stats;
        const double budget = mode == Mode::off ? 0 : double(options.budget_ms);
        std::fprintf(csv, "%ld,%.3f,%.4f,%.3f,", frame, seconds_since(program_start), time, frame_ms);
        std::fprintf(csv, "%.3f,%.3f,%.3f,", work.update_ms, work.upload_ms, budget);
        std::fprintf(csv, "%llu,%.6g,", (unsigned long long)s.rays, double(s.visible_error));
        std::fprintf(csv, "%.6g,%.6g,", double(s.visible_finished), double(s.finished));
        std::fprintf(csv, "%zu,%zu,%u,", work.rects, work.texels * TEXEL_BYTES, s.cells_promoted);
        std::fprintf(csv, "%llu,%u\n", (unsigned long long)s.bytes, s.light_pending);
    }

    void print(const Work &work) {
        const bk_live_stats &stats = work.stats;
        static const char *const modes[] = {"view-based", "position-based", "off"};
        overlay.print(text("%s, direct light %s%s", modes[int(mode)],
                           look.direct_from_shadow_maps ? "by shadow maps" : "baked",
                           light.is_switched_off() ? ", first light off" : ""));
        overlay.print(text("frame %.1f ms; update %.1f, upload %.1f", frame_ms, work.update_ms, work.upload_ms));
        overlay.print(text("%.1fk rays, %.1fM in all", double(stats.rays) / 1e3, double(stats.total_rays) / 1e6));
        if (!light.warning.empty()) overlay.print(light.warning, {1, 0.6f, 0.1f});
        if (renderer.shows_nothing()) {
            overlay.print("no light where the camera looks", {1, 0.6f, 0.1f});
        } else {
            overlay.print(text("error %.1f %% of what is seen%s", 100.0 * double(stats.visible_error),
                               stats.light_pending ? ", light pending" : ""));
        }
        overlay.print(text("finished %.1f %% of what is seen, %.1f %% of all", 100.0 * double(stats.visible_finished),
                           100.0 * double(stats.finished)));
        overlay.print(text("%.1f MB of %.1f", double(stats.bytes) / 1e6, double(stats.bytes_full) / 1e6));
        if (!look.heat_map) return;
        const Vec3 colors[] = {{1, 0.3f, 0.3f}, {1, 0.8f, 0.1f}, {0.2f, 0.9f, 0.3f}, {0.3f, 0.6f, 1}};
        for (uint32_t lod = 0; lod <= light.highest_lod(); lod++) overlay.print(text("LOD %u", lod), colors[lod]);
    }

    void write_screenshots(long frame) {
        if (options.screenshot_every > 0 && frame % options.screenshot_every == 0) {
            write_screenshot(text("/frame%05ld.png", frame));
        }
        while (screenshots_at < options.screenshot_at.size() && time >= options.screenshot_at[screenshots_at]) {
            write_screenshot(text("/at%g.png", options.screenshot_at[screenshots_at++]));
        }
    }

    void write_screenshot(const std::string &name) const {
        std::vector<uint8_t> rgb(size_t(width) * height * 3);
        gl::BindFramebuffer(GL_FRAMEBUFFER, target);
        gl::ReadPixels(0, 0, width, height, GL_RGB, GL_UNSIGNED_BYTE, rgb.data());
        write_png(options.out + name, width, height, rgb);
    }

    // Dirty rectangles must have brought every texel that the light map has.
    void check_textures() const {
        const std::vector<uint16_t> uploaded = renderer.uploaded();
        std::vector<uint16_t> whole;
        light.everything(!look.direct_from_shadow_maps, [&](const bk_rect &rect, const void *texels) {
            const auto *halves = static_cast<const uint16_t *>(texels);
            whole.insert(whole.end(), halves, halves + size_t(rect.width) * rect.height * 4);
        });
        size_t wrong = 0;
        for (size_t i = 0; i < whole.size(); i++) wrong += whole[i] != uploaded[i];
        if (wrong == 0) return;
        throw std::runtime_error(text("%zu of %zu numbers of the light map are not in the textures", wrong, whole.size()));
    }

    const Options &options;
    GLFWwindow *window;
    Overlay &overlay;
    LiveLight &light;
    Walker walker;
    Renderer renderer;
    std::optional<Path> path;
    GLuint target = 0; // 0 is the window
    int width, height;
    Mode mode;
    Look look;
    bool overlay_shown, all_is_new = false, is_starting = true, finds_exposure = true;
    long pictures = 0;
    double time = 0, frame_ms = 0; // frame_ms: of the frame before
    size_t screenshots_at = 0;
    std::FILE *csv = nullptr;
};

} // namespace

int main(int argc, char **argv) {
    try {
        const Options options = parse_options(argc, argv);
        const Window window(options);
        Overlay overlay;
        const std::unique_ptr<LiveLight> light = load(options, window.handle, overlay);
        if (light) Viewer(options, window, overlay, *light).run();
        return 0;
    } catch (const std::exception &e) {
        std::fprintf(stderr, "viewer: %s\n", e.what());
        return 1;
    }
}
