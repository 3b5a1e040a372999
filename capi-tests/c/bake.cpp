// The C API from C++17: handles in RAII wrappers, queries from many threads, wrong concurrent use,
// cancelling in every stage, the same bits for any number of threads.
//
//     bake_cpp OUT_PREFIX

#include "check.h"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cmath>
#include <cstring>
#include <functional>
#include <limits>
#include <memory>
#include <mutex>
#include <set>
#include <string>
#include <thread>
#include <vector>

namespace {

struct Release {
    void operator()(bk_device *p) const { bk_device_release(p); }
    void operator()(bk_scene *p) const { bk_scene_release(p); }
    void operator()(bk_photon_map *p) const { bk_photon_map_release(p); }
    void operator()(bk_lightmap *p) const { bk_lightmap_release(p); }
};
using Device = std::unique_ptr<bk_device, Release>;
using Scene = std::unique_ptr<bk_scene, Release>;
using PhotonMap = std::unique_ptr<bk_photon_map, Release>;
using Lightmap = std::unique_ptr<bk_lightmap, Release>;

// A progress callback made of a lambda.
using Progress = std::function<bool(float fraction, const std::string &stage)>;

int32_t call_progress(void *user, float fraction, const char *stage) {
    return (*static_cast<const Progress *>(user))(fraction, stage) ? 1 : 0;
}

void *user(const Progress &progress) { return const_cast<Progress *>(&progress); }

Device make_device(uint32_t threads) {
    bk_device_desc desc;
    bk_device_desc_init(&desc);
    desc.num_threads = threads;
    bk_device *device = nullptr;
    CHECK_OK(bk_device_create(&desc, &device));
    return Device(device);
}

Scene make_scene(bk_device *device, const char *builtin, bool commit = true) {
    bk_scene *scene = nullptr;
    CHECK_OK(bk_scene_create(device, &scene));
    CHECK_OK(bk_scene_load_builtin(scene, builtin));
    if (commit) CHECK_OK(bk_scene_commit(scene, nullptr, nullptr));
    return Scene(scene);
}

Lightmap make_lightmap(const bk_scene *scene) {
    bk_lightmap_desc desc;
    bk_lightmap_desc_init(&desc);
    desc.page_size = 64;
    bk_lightmap *lightmap = nullptr;
    CHECK_OK(bk_lightmap_create(scene, &desc, nullptr, nullptr, &lightmap));
    return Lightmap(lightmap);
}

bk_bake_params quick() {
    bk_bake_params params;
    bk_bake_params_init(&params);
    params.photon_count = 20000;
    params.gather_rays = 16;
    params.direct_samples = 4;
    params.seed = 11;
    return params;
}

std::vector<float> read_all(const bk_lightmap *lightmap, uint32_t layer) {
    bk_lightmap_info info;
    bk_lightmap_info_init(&info);
    CHECK_OK(bk_lightmap_get_info(lightmap, &info));
    const size_t page = size_t(info.width) * info.height * 3;
    std::vector<float> pixels(page * info.page_count);
    for (uint32_t p = 0; p < info.page_count; p++) {
        CHECK_OK(bk_lightmap_read(lightmap, p, layer, BK_FORMAT_RGB32F, pixels.data() + page * p, 0));
    }
    return pixels;
}

bool same_bits(const std::vector<float> &a, const std::vector<float> &b) {
    return a.size() == b.size() && std::memcmp(a.data(), b.data(), a.size() * sizeof(float)) == 0;
}

bool any_light(const std::vector<float> &a) {
    for (float x : a) {
        if (x > 0.0f) return true;
    }
    return false;
}

// Rays in all directions from the middle of the Cornell box.
std::vector<bk_ray> make_rays(const bk_scene *scene, size_t count) {
    float lower[3], upper[3];
    CHECK_OK(bk_scene_bounds(scene, lower, upper));
    std::vector<bk_ray> rays(count);
    for (size_t i = 0; i < count; i++) {
        const double z = 1.0 - 2.0 * (double(i) + 0.5) / double(count), phi = 2.399963 * double(i);
        const double r = std::sqrt(1.0 - z * z);
        for (int c = 0; c < 3; c++) rays[i].origin[c] = 0.5f * (lower[c] + upper[c]);
        rays[i].direction[0] = float(r * std::cos(phi));
        rays[i].direction[1] = float(r * std::sin(phi));
        rays[i].direction[2] = float(z);
        rays[i].tmin = 0.0f;
        rays[i].tmax = std::numeric_limits<float>::infinity();
    }
    return rays;
}

bool equal(const std::vector<bk_hit> &a, const std::vector<bk_hit> &b) {
    return a.size() == b.size() && std::memcmp(a.data(), b.data(), a.size() * sizeof(bk_hit)) == 0;
}

// A committed scene answers many threads at once, each by all kinds of query, and always the same.
void queries_from_many_threads() {
    Device device = make_device(2);
    Scene scene = make_scene(device.get(), "cornell");
    device.reset();
    const std::vector<bk_ray> rays = make_rays(scene.get(), 4096);
    std::vector<bk_hit> expected(rays.size());
    CHECK_OK(bk_intersect_many(scene.get(), rays.data(), rays.size(), 0, expected.data()));

    std::vector<float> directions;
    for (const bk_ray &ray : rays) directions.insert(directions.end(), ray.direction, ray.direction + 3);
    std::atomic<int> wrong{0};
    std::vector<std::thread> threads;
    for (int t = 0; t < 8; t++) {
        threads.emplace_back([&, t] {
            bk_scene_retain(scene.get());
            Scene mine(scene.get());
            std::vector<bk_hit> hits(rays.size());
            std::vector<uint8_t> occluded(rays.size());
            for (int round = 0; round < 4; round++) {
                const uint32_t flags = t % 2 ? BK_RAYS_PARALLEL : 0;
                wrong += bk_intersect_many(mine.get(), rays.data(), rays.size(), flags, hits.data()) != BK_OK;
                wrong += !equal(hits, expected);
                for (size_t i = 0; i < rays.size(); i++) bk_intersect(mine.get(), &rays[i], &hits[i]);
                wrong += !equal(hits, expected);
                wrong += bk_gather(mine.get(), rays[0].origin, directions.data(), rays.size(), rays[0].tmax, 0,
                                   hits.data()) != BK_OK;
                for (size_t i = 0; i < rays.size(); i++) wrong += hits[i].triangle != expected[i].triangle;
                wrong += bk_occluded_many(mine.get(), rays.data(), rays.size(), flags, occluded.data()) != BK_OK;
                for (size_t i = 0; i < rays.size(); i++) wrong += occluded[i] != (expected[i].triangle != BK_NONE);
            }
        });
    }
    for (std::thread &thread : threads) thread.join();
    CHECK(wrong == 0);
}

// The last error is the thread's own.
void errors_are_per_thread() {
    CHECK_ERROR(bk_scene_commit(nullptr, nullptr, nullptr), BK_ERROR_INVALID_ARGUMENT, "scene is NULL");
    std::thread([] {
        CHECK(std::string(bk_last_error()).empty());
        CHECK_ERROR(bk_device_create(nullptr, nullptr), BK_ERROR_INVALID_ARGUMENT, "out is NULL");
    }).join();
    CHECK(std::string(bk_last_error()).find("scene is NULL") != std::string::npos);
}

// Devices with 1, 2 and 7 threads give the same bits; so do two shards that make up a whole bake.
void same_bits_for_any_thread_count() {
    std::vector<float> expected[3];
    const uint32_t layers[3] = {BK_LAYER_DIRECT, BK_LAYER_INDIRECT, BK_LAYER_RADIANCE};
    for (uint32_t threads : {1u, 2u, 7u}) {
        Device device = make_device(threads);
        CHECK(bk_device_num_threads(device.get()) == threads);
        Scene scene = make_scene(device.get(), "cornell");
        Lightmap lightmap = make_lightmap(scene.get());
        bk_bake_params params = quick();
        CHECK_OK(bk_bake(lightmap.get(), &params, nullptr, nullptr, nullptr));
        for (int l = 0; l < 3; l++) {
            std::vector<float> pixels = read_all(lightmap.get(), layers[l]);
            if (threads == 1) {
                expected[l] = pixels;
                CHECK(any_light(pixels));
            } else {
                CHECK(same_bits(pixels, expected[l]));
            }
        }
        bk_lightmap_info info;
        bk_lightmap_info_init(&info);
        CHECK_OK(bk_lightmap_get_info(lightmap.get(), &info));
        Lightmap sharded = make_lightmap(scene.get());
        params.texel_end = info.texels / 3;
        CHECK_OK(bk_bake(sharded.get(), &params, nullptr, nullptr, nullptr));
        CHECK(!same_bits(read_all(sharded.get(), BK_LAYER_DIRECT), expected[0]));
        params.texel_begin = params.texel_end;
        params.texel_end = 0;
        CHECK_OK(bk_bake(sharded.get(), &params, nullptr, nullptr, nullptr));
        CHECK(same_bits(read_all(sharded.get(), BK_LAYER_DIRECT), expected[0]));
        CHECK(same_bits(read_all(sharded.get(), BK_LAYER_INDIRECT), expected[1]));
    }
}

// Cancelled at the first report of every stage in turn, a light map can be baked again and then holds
// the same bits as one that was never disturbed.
void cancel_in_every_stage() {
    Device device = make_device(2);
    Scene scene = make_scene(device.get(), "cornell");
    const bk_bake_params params = quick();
    Lightmap undisturbed = make_lightmap(scene.get());
    std::vector<std::string> stages;
    const Progress watch = [&](float, const std::string &stage) {
        if (stages.empty() || stages.back() != stage) stages.push_back(stage);
        return true;
    };
    CHECK_OK(bk_bake(undisturbed.get(), &params, call_progress, user(watch), nullptr));
    CHECK(stages.size() >= 4);

    Lightmap lightmap = make_lightmap(scene.get());
    for (const std::string &name : stages) {
        int calls_after = -1;
        const Progress cancel = [&](float, const std::string &stage) {
            if (calls_after >= 0) calls_after++;
            if (stage == name && calls_after < 0) calls_after = 0;
            return calls_after < 0;
        };
        CHECK_ERROR(bk_bake(lightmap.get(), &params, call_progress, user(cancel), nullptr), BK_ERROR_CANCELLED,
                    "cancelled");
        CHECK(calls_after == 0); // nothing is reported after the cancel
    }
    CHECK_OK(bk_bake(lightmap.get(), &params, nullptr, nullptr, nullptr));
    const std::vector<float> baked = read_all(lightmap.get(), BK_LAYER_COMBINED);
    CHECK(same_bits(baked, read_all(undisturbed.get(), BK_LAYER_COMBINED)));

    // A cancelled bake keeps what was baked before.
    const Progress no = [](float, const std::string &) { return false; };
    bk_bake_params other = params;
    other.seed++;
    CHECK_ERROR(bk_bake(lightmap.get(), &other, call_progress, user(no), nullptr), BK_ERROR_CANCELLED, "cancelled");
    CHECK(same_bits(baked, read_all(lightmap.get(), BK_LAYER_COMBINED)));
}

// What a callback may not do fails with BK_ERROR_INVALID_STATE and does no harm.
void calls_from_callbacks() {
    Device device = make_device(2);
    Scene scene = make_scene(device.get(), "cornell", false);
    int reports = 0;
    const Progress meddle = [&](float, const std::string &) {
        bk_material_desc material;
        bk_material_desc_init(&material);
        reports++;
        CHECK_ERROR(bk_scene_add_material(scene.get(), &material, nullptr), BK_ERROR_INVALID_STATE, "at the same time");
        CHECK_ERROR(bk_scene_commit(scene.get(), nullptr, nullptr), BK_ERROR_INVALID_STATE, "callback");
        return true;
    };
    CHECK_OK(bk_scene_commit(scene.get(), call_progress, user(meddle)));
    CHECK(reports > 0);

    Lightmap lightmap = make_lightmap(scene.get());
    const bk_bake_params params = quick();
    reports = 0;
    const Progress meddle_again = [&](float, const std::string &) {
        bk_lightmap_info info;
        bk_lightmap_info_init(&info);
        reports++;
        CHECK_ERROR(bk_bake(lightmap.get(), &params, nullptr, nullptr, nullptr), BK_ERROR_INVALID_STATE, "callback");
        CHECK_ERROR(bk_lightmap_get_info(lightmap.get(), &info), BK_ERROR_INVALID_STATE, "being baked");
        const bk_ray ray = {{0, 0, 0}, 0, {0, 0, 1}, 1};
        bk_hit hit;
        CHECK_OK(bk_intersect_many(scene.get(), &ray, 1, 0, &hit)); // queries are fine
        CHECK_ERROR(bk_intersect_many(scene.get(), &ray, 1, BK_RAYS_PARALLEL, &hit), BK_ERROR_INVALID_STATE,
                    "callback");
        return true;
    };
    CHECK_OK(bk_bake(lightmap.get(), &params, call_progress, user(meddle_again), nullptr));
    CHECK(reports > 0);

    // A callback that releases the caller's last reference leaves the call its own.
    bk_scene *last = make_scene(device.get(), "furnace", false).release();
    bool released = false;
    const Progress let_go = [&](float, const std::string &) {
        if (!released) bk_scene_release(last);
        released = true;
        return true;
    };
    CHECK_OK(bk_scene_commit(last, call_progress, user(let_go)));
    CHECK(released);
}

// While one thread bakes, reads and second bakes of others are refused, never undefined.
void bakes_and_reads_at_the_same_time() {
    Device device = make_device(2);
    Scene scene = make_scene(device.get(), "cornell");
    Lightmap lightmap = make_lightmap(scene.get());
    const bk_bake_params params = quick();
    CHECK_OK(bk_bake(lightmap.get(), &params, nullptr, nullptr, nullptr));
    const std::vector<float> expected = read_all(lightmap.get(), BK_LAYER_COMBINED);

    std::atomic<bool> done{false};
    std::atomic<int> wrong{0};
    std::mutex seen_lock;
    std::set<bk_result> seen;
    std::vector<std::thread> readers;
    for (int t = 0; t < 3; t++) {
        readers.emplace_back([&] {
            std::vector<float> pixels(expected.size());
            while (!done) {
                const bk_result r =
                    bk_lightmap_read(lightmap.get(), 0, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, pixels.data(), 0);
                wrong += r != BK_OK && r != BK_ERROR_INVALID_STATE;
                wrong += r == BK_OK && std::memcmp(pixels.data(), expected.data(), 64 * 64 * 12) != 0;
                {
                    std::lock_guard<std::mutex> guard(seen_lock);
                    seen.insert(r);
                }
                // Readers that never pause would keep the bake from beginning.
                std::this_thread::sleep_for(std::chrono::milliseconds(1));
            }
        });
    }
    for (int i = 0; i < 8; i++) {
        bk_result r;
        do {
            r = bk_bake(lightmap.get(), &params, nullptr, nullptr, nullptr);
        } while (r == BK_ERROR_INVALID_STATE); // a reader was faster
        CHECK_OK(r);
    }
    done = true;
    for (std::thread &reader : readers) reader.join();
    CHECK(wrong == 0);
    CHECK(seen.count(BK_ERROR_INVALID_STATE) == 1);
    CHECK(same_bits(expected, read_all(lightmap.get(), BK_LAYER_COMBINED)));
}

// Estimates from many threads; lights that change between bakes.
void photons_and_lights() {
    Device device = make_device(2);
    Scene scene = make_scene(device.get(), "cornell");
    bk_photon_params params;
    bk_photon_params_init(&params);
    params.photon_count = 20000;
    bk_photon_map *handle = nullptr;
    CHECK_OK(bk_photon_map_create(scene.get(), &params, nullptr, nullptr, &handle));
    PhotonMap map(handle);
    bk_photon_view view;
    bk_photon_view_init(&view);
    CHECK_OK(bk_photon_map_get_photons(map.get(), &view));
    const size_t count = std::min<size_t>(view.count, 1000);
    CHECK(count > 0);
    std::vector<float> normals(3 * count), expected(3 * count);
    for (size_t i = 0; i < 3 * count; i++) normals[i] = -view.direction[i];
    CHECK_OK(bk_photon_map_estimate(map.get(), view.position, normals.data(), count, expected.data()));
    std::atomic<int> wrong{0};
    std::vector<std::thread> threads;
    for (int t = 0; t < 4; t++) {
        threads.emplace_back([&] {
            std::vector<float> e(3 * count);
            wrong += bk_photon_map_estimate(map.get(), view.position, normals.data(), count, e.data()) != BK_OK;
            wrong += !same_bits(e, expected);
        });
    }
    for (std::thread &thread : threads) thread.join();
    CHECK(wrong == 0 && any_light(expected));

    // Doubling the only light doubles direct light exactly.
    if (bk_scene_light_count(scene.get()) == 1) {
        float lower[3], upper[3];
        CHECK_OK(bk_scene_bounds(scene.get(), lower, upper));
        bk_light_desc light;
        bk_light_desc_init(&light);
        for (int c = 0; c < 3; c++) light.position[c] = 0.5f * (lower[c] + upper[c]);
        Lightmap lightmap = make_lightmap(scene.get());
        std::vector<float> direct[2];
        for (int i = 0; i < 2; i++) {
            for (float &c : light.color) c = float(i + 1);
            CHECK_OK(bk_scene_set_light(scene.get(), 0, &light));
            bk_bake_params bake = quick();
            bake.gather_rays = 0;
            CHECK_OK(bk_bake(lightmap.get(), &bake, nullptr, nullptr, nullptr));
            direct[i] = read_all(lightmap.get(), BK_LAYER_DIRECT);
        }
        for (float &x : direct[0]) x *= 2.0f;
        CHECK(same_bits(direct[0], direct[1]) && any_light(direct[1]));
    }
}

} // namespace

int main(int argc, char **argv) {
    queries_from_many_threads();
    errors_are_per_thread();
    same_bits_for_any_thread_count();
    cancel_in_every_stage();
    calls_from_callbacks();
    bakes_and_reads_at_the_same_time();
    photons_and_lights();

    Device device = make_device(0);
    Scene scene = make_scene(device.get(), "furnace");
    Lightmap lightmap = make_lightmap(scene.get());
    device.reset();
    scene.reset();
    const bk_bake_params params = quick();
    CHECK_OK(bk_bake(lightmap.get(), &params, nullptr, nullptr, nullptr));
    CHECK_OK(bk_lightmap_save(lightmap.get(), argc > 1 ? argv[1] : "", BK_FILE_GLB, nullptr, nullptr));
    return check_report("bake_cpp");
}
