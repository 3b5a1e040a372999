/**
 * @file bakelite.hpp
 * C++17 wrapper of bakelite.h: handles that release themselves, descriptions that start with their defaults, spans
 * instead of pointers with lengths, lambdas as progress callbacks, errors as exceptions or as return values.
 *
 *     bakelite::Device device = bakelite::Device::create();
 *     bakelite::Scene scene = bakelite::Scene::create(device);
 *     scene.load_builtin("cornell");
 *     scene.commit();
 *     bakelite::Lightmap map = bakelite::Lightmap::create(scene);
 *     map.bake({}, [](float fraction, const char *stage) { return keep_going(fraction, stage); });
 *     std::vector<float> rgb = map.read(0, BK_LAYER_COMBINED);
 *
 * bakelite.h says what each call means, and all that it offers remains usable: get() gives the C handle. The wrapper is
 * inline code, needs no library of its own and allocates only what it returns.
 *
 * Errors: a call that fails throws bakelite::Error. With -fno-exceptions, or if BAKELITE_NO_EXCEPTIONS is defined, it
 * returns Result<T> instead, which must be looked at before its value is taken.
 */
#ifndef BAKELITE_HPP
#define BAKELITE_HPP

#include "bakelite.h"

#include <array>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

#if !defined(BAKELITE_NO_EXCEPTIONS) && !defined(__cpp_exceptions) && !defined(_CPPUNWIND)
#define BAKELITE_NO_EXCEPTIONS
#endif

#ifdef BAKELITE_NO_EXCEPTIONS
#include <cstdlib>
#else
#include <exception>
#include <stdexcept>
#endif

namespace bakelite {

// ---- Errors ----

#ifdef BAKELITE_NO_EXCEPTIONS

/// A value, or the reason why there is none.
template <class T>
class [[nodiscard]] Result {
public:
    Result(bk_result code, const char *message, T value) : code_(code), message_(message), value_(std::move(value)) {}
    /// Whether there is a value.
    explicit operator bool() const { return code_ == BK_OK; }
    bk_result code() const { return code_; }
    /// What is wrong; valid until the thread's next call into the library.
    const char *message() const { return message_; }
    /// The value; ends the program if there is none.
    T &value() & { return checked(); }
    T value() && { return std::move(checked()); }

private:
    T &checked() {
        if (code_ != BK_OK)
            std::abort();
        return value_;
    }
    bk_result code_;
    const char *message_;
    T value_;
};

/// Success, or the reason of a failure.
template <>
class [[nodiscard]] Result<void> {
public:
    Result(bk_result code, const char *message) : code_(code), message_(message) {}
    explicit operator bool() const { return code_ == BK_OK; }
    bk_result code() const { return code_; }
    const char *message() const { return message_; }

private:
    bk_result code_;
    const char *message_;
};

#else

/// What a call that fails throws; what() is the sentence of bk_last_error().
class Error : public std::runtime_error {
public:
    Error(bk_result code, const char *message) : std::runtime_error(message), code_(code) {}
    bk_result code() const noexcept { return code_; }

private:
    bk_result code_;
};

template <class T>
using Result = T;

#endif

namespace detail {

inline Result<void> finish(bk_result code, const char *message = nullptr) {
    if (!message)
        message = code == BK_OK ? "" : bk_last_error();
#ifdef BAKELITE_NO_EXCEPTIONS
    return {code, message};
#else
    if (code != BK_OK)
        throw Error(code, message);
#endif
}

template <class T>
Result<T> finish(bk_result code, T value) {
#ifdef BAKELITE_NO_EXCEPTIONS
    return {code, code == BK_OK ? "" : bk_last_error(), std::move(value)};
#else
    if (code != BK_OK)
        throw Error(code, bk_last_error());
    return value;
#endif
}

} // namespace detail

// ---- Spans ----

/// Elements that somebody else owns: of a vector, an array, a std::span, or `size` of them from `data` on.
template <class T>
class Span {
public:
    constexpr Span() = default;
    constexpr Span(T *data, std::size_t size) : data_(data), size_(size) {}
    template <std::size_t N>
    constexpr Span(T (&array)[N]) : data_(array), size_(N) {}
    template <class C, class = std::enable_if_t<std::is_convertible_v<
                           std::remove_pointer_t<decltype(std::declval<C &>().data())> (*)[], T (*)[]>>>
    constexpr Span(C &&container) : data_(container.data()), size_(container.size()) {}
    constexpr T *data() const { return data_; }
    constexpr std::size_t size() const { return size_; }
    constexpr T *begin() const { return data_; }
    constexpr T *end() const { return data_ + size_; }
    constexpr T &operator[](std::size_t i) const { return data_[i]; }

private:
    T *data_ = nullptr;
    std::size_t size_ = 0;
};

/// Vectors of N floats at equal distances: packed floats, or structures that start with the vector (positions of a
/// vertex, an engine's own vector type). Nothing is copied.
template <std::size_t N>
class Vectors {
public:
    Vectors() = default;
    Vectors(const float *data, std::size_t count, std::size_t stride = N * sizeof(float))
        : data_(data), count_(count), stride_(stride) {}
    template <class C, class T = std::remove_cv_t<std::remove_pointer_t<decltype(std::declval<const C &>().data())>>>
    Vectors(const C &container) {
        if constexpr (std::is_same_v<T, float>) {
            *this = Vectors(container.data(), container.size() / N);
        } else {
            static_assert(std::is_trivially_copyable_v<T> && sizeof(T) >= N * sizeof(float) && alignof(T) >= alignof(float),
                          "the elements must start with a vector of floats");
            *this = Vectors(reinterpret_cast<const float *>(container.data()), container.size(), sizeof(T));
        }
    }
    const float *data() const { return data_; }
    std::size_t count() const { return count_; }
    /// In bytes.
    std::size_t stride() const { return stride_; }

private:
    const float *data_ = nullptr;
    std::size_t count_ = 0;
    std::size_t stride_ = 0;
};

// ---- Descriptions: the structures of bakelite.h, which start with their defaults ----

#define BAKELITE_STRUCT(Name, c_name)                                                                                  \
    struct Name : c_name {                                                                                             \
        Name() { c_name##_init(this); }                                                                                \
    }
BAKELITE_STRUCT(DeviceDesc, bk_device_desc);
BAKELITE_STRUCT(LoadParams, bk_load_params);
BAKELITE_STRUCT(OpenParams, bk_open_params);
BAKELITE_STRUCT(LoadInfo, bk_load_info);
BAKELITE_STRUCT(BuildParams, bk_build_params);
BAKELITE_STRUCT(SceneStats, bk_scene_stats);
BAKELITE_STRUCT(TextureDesc, bk_texture_desc);
BAKELITE_STRUCT(MaterialDesc, bk_material_desc);
BAKELITE_STRUCT(MeshView, bk_mesh_view);
BAKELITE_STRUCT(LightDesc, bk_light_desc);
BAKELITE_STRUCT(PhotonParams, bk_photon_params);
BAKELITE_STRUCT(PhotonView, bk_photon_view);
BAKELITE_STRUCT(LightmapDesc, bk_lightmap_desc);
BAKELITE_STRUCT(LightmapInfo, bk_lightmap_info);
BAKELITE_STRUCT(BakeParams, bk_bake_params);
BAKELITE_STRUCT(BakeStats, bk_bake_stats);
BAKELITE_STRUCT(LiveParams, bk_live_params);
BAKELITE_STRUCT(LiveStats, bk_live_stats);
BAKELITE_STRUCT(Camera, bk_camera);
BAKELITE_STRUCT(Budget, bk_budget);
#undef BAKELITE_STRUCT

/// A mesh: set the rest (material, strict flag) as fields of bk_mesh_desc.
struct MeshDesc : bk_mesh_desc {
    MeshDesc() { bk_mesh_desc_init(this); }
    /// `triangles`: three vertex numbers each.
    MeshDesc(Vectors<3> vertices, Span<const std::uint32_t> triangles) : MeshDesc() {
        positions = vertices.data();
        position_stride = vertices.stride();
        vertex_count = vertices.count();
        indices = triangles.data();
        triangle_count = triangles.size() / 3;
    }
    MeshDesc &with_normals(Vectors<3> vectors) {
        normals = vectors.data();
        normal_stride = vectors.stride();
        return *this;
    }
    MeshDesc &with_uvs(Vectors<2> vectors) {
        uvs = vectors.data();
        uv_stride = vectors.stride();
        return *this;
    }
    MeshDesc &with_lightmap_uvs(Vectors<2> vectors) {
        lightmap_uvs = vectors.data();
        lightmap_uv_stride = vectors.stride();
        return *this;
    }
};

// ---- Progress ----

/// A callable `bool(float fraction, const char *stage)` for the time of a call; false cancels. What it throws cancels
/// too, and comes out of the call.
class Progress {
public:
    Progress() = default;
    template <class F, class = std::enable_if_t<std::is_invocable_r_v<bool, F &, float, const char *>>>
    Progress(F &&callable)
        : callable_(const_cast<void *>(static_cast<const void *>(std::addressof(callable)))),
          invoke_([](void *f, float fraction, const char *stage) -> bool {
              return (*static_cast<std::remove_reference_t<F> *>(f))(fraction, stage);
          }) {}
    bk_progress_fn function() const { return invoke_ ? &report : nullptr; }
    void *user() const { return const_cast<Progress *>(this); }
    /// To be called with what the call returned.
    bk_result after(bk_result code) const {
#ifndef BAKELITE_NO_EXCEPTIONS
        if (thrown_)
            std::rethrow_exception(thrown_);
#endif
        return code;
    }

private:
    static std::int32_t report(void *user, float fraction, const char *stage) {
        auto *self = static_cast<Progress *>(user);
#ifdef BAKELITE_NO_EXCEPTIONS
        return self->invoke_(self->callable_, fraction, stage);
#else
        if (self->thrown_)
            return 0;
        try {
            return self->invoke_(self->callable_, fraction, stage);
        } catch (...) {
            self->thrown_ = std::current_exception();
            return 0;
        }
#endif
    }
    void *callable_ = nullptr;
    bool (*invoke_)(void *, float, const char *) = nullptr;
#ifndef BAKELITE_NO_EXCEPTIONS
    std::exception_ptr thrown_;
#endif
};

// ---- Handles ----

/// A reference to an object of the library, or none. Copies share the object.
template <class C, void (*Retain)(C *), void (*Release)(C *)>
class Handle {
public:
    Handle() = default;
    /// Takes over a reference that the caller owns.
    explicit Handle(C *owned) noexcept : object_(owned) {}
    Handle(const Handle &other) noexcept : object_(other.object_) {
        if (object_)
            Retain(object_);
    }
    Handle(Handle &&other) noexcept : object_(std::exchange(other.object_, nullptr)) {}
    Handle &operator=(Handle other) noexcept {
        std::swap(object_, other.object_);
        return *this;
    }
    ~Handle() {
        // Not without an object: each call into the library ends the life of bk_last_error's sentence.
        if (object_)
            Release(object_);
    }
    C *get() const noexcept { return object_; }
    /// Gives the reference to the caller.
    C *release() noexcept { return std::exchange(object_, nullptr); }
    explicit operator bool() const noexcept { return object_ != nullptr; }

private:
    C *object_ = nullptr;
};

/// Worker threads, instruction set and log.
class Device : public Handle<bk_device, bk_device_retain, bk_device_release> {
public:
    using Handle::Handle;
    static Result<Device> create(const DeviceDesc &desc = {}) {
        bk_device *out = nullptr;
        const bk_result code = bk_device_create(&desc, &out);
        return detail::finish(code, Device(out));
    }
    std::uint32_t isa() const { return bk_device_isa(get()); }
    std::uint32_t num_threads() const { return bk_device_num_threads(get()); }
};

/// A scene, described and then committed.
class Scene : public Handle<bk_scene, bk_scene_retain, bk_scene_release> {
public:
    using Handle::Handle;
    static Result<Scene> create(const Device &device) {
        bk_scene *out = nullptr;
        const bk_result code = bk_scene_create(device.get(), &out);
        return detail::finish(code, Scene(out));
    }

    Result<LoadInfo> load_file(const std::string &path, const LoadParams &params = {}, const Progress &progress = {}) {
        LoadInfo info;
        return detail::finish(progress.after(bk_scene_load_file(get(), path.c_str(), &params, progress.function(),
                                                                progress.user(), &info)),
                              info);
    }
    Result<void> load_builtin(const std::string &name) {
        return detail::finish(bk_scene_load_builtin(get(), name.c_str()));
    }
    Result<std::uint32_t> add_texture(const TextureDesc &desc) { return add(bk_scene_add_texture, desc); }
    Result<std::uint32_t> add_environment(const TextureDesc &desc) { return add(bk_scene_add_environment, desc); }
    Result<std::uint32_t> add_material(const MaterialDesc &desc) { return add(bk_scene_add_material, desc); }
    Result<std::uint32_t> add_mesh(const MeshDesc &desc) { return add(bk_scene_add_mesh, desc); }
    /// `transform`: images of the x, y and z axis, then the translation.
    Result<std::uint32_t> add_instance(std::uint32_t mesh, const float (&transform)[12]) {
        std::uint32_t id = 0;
        const bk_result code = bk_scene_add_instance(get(), mesh, transform, &id);
        return detail::finish(code, id);
    }
    /// Lets an instance show the light of another one of its mesh, with a lower number.
    Result<void> share_light(std::uint32_t instance, std::uint32_t of) {
        return detail::finish(bk_instance_share_light(get(), instance, of));
    }
    Result<std::uint32_t> add_light(const LightDesc &desc) { return add(bk_scene_add_light, desc); }
    Result<void> set_light(std::uint32_t id, const LightDesc &desc) {
        return detail::finish(bk_scene_set_light(get(), id, &desc));
    }
    Result<void> set_build(const BuildParams &params) { return detail::finish(bk_scene_set_build(get(), &params)); }
    Result<void> commit(const Progress &progress = {}) {
        return detail::finish(progress.after(bk_scene_commit(get(), progress.function(), progress.user())));
    }
    /// Takes over trees of meshes that are as they were in an earlier scene.
    Result<void> commit_from(const Scene &earlier, const Progress &progress = {}) {
        return detail::finish(
            progress.after(bk_scene_commit_from(get(), earlier.get(), progress.function(), progress.user())));
    }
    Result<void> save(const std::string &path, const Progress &progress = {}) const {
        return detail::finish(progress.after(bk_scene_save(get(), path.c_str(), progress.function(), progress.user())));
    }
    /// Instead of a description and commit().
    Result<void> open(const std::string &path, const OpenParams &params = {}, const Progress &progress = {}) {
        return detail::finish(
            progress.after(bk_scene_open(get(), path.c_str(), &params, progress.function(), progress.user())));
    }
    Result<void> set_positions(std::uint32_t mesh, Vectors<3> vertices) {
        return detail::finish(
            bk_mesh_set_positions(get(), mesh, vertices.data(), vertices.count(), vertices.stride()));
    }
    Result<void> set_transform(std::uint32_t instance, const float (&transform)[12]) {
        return detail::finish(bk_instance_set_transform(get(), instance, transform));
    }
    Result<void> refit() { return detail::finish(bk_scene_refit(get())); }

    Result<SceneStats> stats() const {
        SceneStats stats;
        return detail::finish(bk_scene_get_stats(get(), &stats), stats);
    }
    /// Lower and upper corner.
    Result<std::pair<std::array<float, 3>, std::array<float, 3>>> bounds() const {
        std::pair<std::array<float, 3>, std::array<float, 3>> box{};
        return detail::finish(bk_scene_bounds(get(), box.first.data(), box.second.data()), box);
    }
    std::uint32_t mesh_count() const { return bk_scene_mesh_count(get()); }
    Result<MeshView> mesh(std::uint32_t number) const {
        MeshView view;
        return detail::finish(bk_scene_get_mesh(get(), number, &view), view);
    }
    std::uint32_t material_count() const { return bk_scene_material_count(get()); }
    Result<MaterialDesc> material(std::uint32_t id) const {
        MaterialDesc desc;
        return detail::finish(bk_scene_get_material(get(), id, &desc), desc);
    }
    std::uint32_t light_count() const { return bk_scene_light_count(get()); }
    Result<LightDesc> light(std::uint32_t id) const {
        LightDesc desc;
        return detail::finish(bk_scene_get_light(get(), id, &desc), desc);
    }
    std::uint32_t texture_count() const { return bk_scene_texture_count(get()); }
    Result<TextureDesc> texture(std::uint32_t id) const {
        TextureDesc desc;
        return detail::finish(bk_scene_get_texture(get(), id, &desc), desc);
    }

    bk_hit intersect(const bk_ray &ray) const {
        bk_hit hit;
        bk_intersect(get(), &ray, &hit);
        return hit;
    }
    bool occluded(const bk_ray &ray) const { return bk_occluded(get(), &ray) != 0; }
    /// `hits` must be as many as the rays.
    Result<void> intersect(Span<const bk_ray> rays, Span<bk_hit> hits, std::uint32_t flags = 0) const {
        if (hits.size() != rays.size())
            return detail::finish(BK_ERROR_INVALID_ARGUMENT, "there are not as many hits as rays");
        return detail::finish(bk_intersect_many(get(), rays.data(), rays.size(), flags, hits.data()));
    }
    /// `hidden` must be as many as the rays.
    Result<void> occluded(Span<const bk_ray> rays, Span<std::uint8_t> hidden, std::uint32_t flags = 0) const {
        if (hidden.size() != rays.size())
            return detail::finish(BK_ERROR_INVALID_ARGUMENT, "there are not as many results as rays");
        return detail::finish(bk_occluded_many(get(), rays.data(), rays.size(), flags, hidden.data()));
    }

private:
    template <class D>
    Result<std::uint32_t> add(bk_result (*function)(bk_scene *, const D *, std::uint32_t *), const std::common_type_t<D> &desc) {
        std::uint32_t id = BK_NONE;
        const bk_result code = function(get(), &desc, &id);
        return detail::finish(code, id);
    }
};

/// Photons on the surfaces of a scene.
class PhotonMap : public Handle<bk_photon_map, bk_photon_map_retain, bk_photon_map_release> {
public:
    using Handle::Handle;
    static Result<PhotonMap> create(const Scene &scene, const PhotonParams &params = {}, const Progress &progress = {}) {
        bk_photon_map *out = nullptr;
        const bk_result code = bk_photon_map_create(scene.get(), &params, progress.function(), progress.user(), &out);
        PhotonMap map(out);
        return detail::finish(progress.after(code), std::move(map));
    }
    /// Irradiance in W/m2; positions, normals and results packed, three floats each.
    Result<void> estimate(Span<const float> positions, Span<const float> normals, Span<float> irradiance) const {
        if (positions.size() % 3 != 0 || normals.size() != positions.size() || irradiance.size() != positions.size())
            return detail::finish(BK_ERROR_INVALID_ARGUMENT,
                                  "positions, normals and irradiance are not three floats for each of the same points");
        return detail::finish(bk_photon_map_estimate(get(), positions.data(), normals.data(), positions.size() / 3,
                                                     irradiance.data()));
    }
    Result<PhotonView> photons() const {
        PhotonView view;
        return detail::finish(bk_photon_map_get_photons(get(), &view), view);
    }
};

/// Light map coordinates of a mesh.
struct MeshUvs {
    /// Six floats per triangle.
    std::vector<float> corners;
    /// Page of each triangle, or BK_NONE.
    std::vector<std::uint32_t> pages;
};

/// Sets the fields that trade error for time to those of a quality (one of the BK_QUALITY values).
inline Result<void> set_quality(std::uint32_t quality, LightmapDesc &desc, BakeParams &params) {
    return detail::finish(bk_quality_set(quality, &desc, &params));
}

/// A light map: its layout and, once baked, light.
class Lightmap : public Handle<bk_lightmap, bk_lightmap_retain, bk_lightmap_release> {
public:
    using Handle::Handle;
    static Result<Lightmap> create(const Scene &scene, const LightmapDesc &desc = {}, const Progress &progress = {}) {
        bk_lightmap *out = nullptr;
        const bk_result code = bk_lightmap_create(scene.get(), &desc, progress.function(), progress.user(), &out);
        Lightmap map(out);
        return detail::finish(progress.after(code), std::move(map));
    }
    /// The light map of a scene that was described anew: takes over charts from that of the scene before.
    static Result<Lightmap> create_from(const Scene &scene, const Lightmap &earlier, const LightmapDesc &desc = {},
                                        const Progress &progress = {}) {
        bk_lightmap *out = nullptr;
        const bk_result code = bk_lightmap_create_from(scene.get(), &desc, earlier.get(), progress.function(),
                                                       progress.user(), &out);
        Lightmap map(out);
        return detail::finish(progress.after(code), std::move(map));
    }
    /// The light map whose layout was saved: as from `create`, without unwrapping.
    static Result<Lightmap> load_layout(const Scene &scene, const std::string &path, const LightmapDesc &desc = {},
                                        const Progress &progress = {}) {
        bk_lightmap *out = nullptr;
        const bk_result code =
            bk_lightmap_load_layout(scene.get(), &desc, path.c_str(), progress.function(), progress.user(), &out);
        Lightmap map(out);
        return detail::finish(progress.after(code), std::move(map));
    }
    Result<void> save_layout(const std::string &path, const Progress &progress = {}) const {
        return detail::finish(
            progress.after(bk_lightmap_save_layout(get(), path.c_str(), progress.function(), progress.user())));
    }
    Result<LightmapInfo> info() const {
        LightmapInfo info;
        return detail::finish(bk_lightmap_get_info(get(), &info), info);
    }
    Result<BakeStats> bake(const BakeParams &params = {}, const Progress &progress = {}) {
        BakeStats stats;
        const bk_result code = bk_bake(get(), &params, progress.function(), progress.user(), &stats);
        return detail::finish(progress.after(code), stats);
    }
    /// Updates the geometry after a refit of the scene; charts and UVs stay.
    Result<void> follow(const Scene &scene, const Progress &progress = {}) {
        return detail::finish(
            progress.after(bk_lightmap_follow(get(), scene.get(), progress.function(), progress.user())));
    }
    /// Bakes what has changed since the last bake, which had the same parameters.
    Result<BakeStats> bake_changed(const BakeParams &params, float keep_error, const Progress &progress = {}) {
        BakeStats stats;
        const bk_result code =
            bk_bake_changed(get(), &params, keep_error, progress.function(), progress.user(), &stats);
        return detail::finish(progress.after(code), stats);
    }
    /// Bakes and keeps light of an earlier light map, of a scene of which this one's is a revision.
    Result<BakeStats> bake_changed_from(const Lightmap &earlier, const BakeParams &params, float keep_error,
                                        const Progress &progress = {}) {
        BakeStats stats;
        const bk_result code = bk_bake_changed_from(get(), earlier.get(), &params, keep_error, progress.function(),
                                                    progress.user(), &stats);
        return detail::finish(progress.after(code), stats);
    }
    /// The plan of the last bake as text.
    std::string plan() const {
        std::string text(bk_plan_describe(get(), nullptr, 0), '\0');
        // data() may be written up to and including the NUL behind the text.
        bk_plan_describe(get(), text.data(), text.size() + 1);
        return text;
    }
    Result<MeshUvs> mesh_uvs(const Scene &scene, std::uint32_t mesh) const {
        MeshView view;
        bk_result code = bk_scene_get_mesh(scene.get(), mesh, &view);
        MeshUvs uvs;
        if (code == BK_OK) {
            uvs.corners.resize(6 * view.triangle_count);
            uvs.pages.resize(view.triangle_count);
            code = bk_lightmap_mesh_uvs(get(), mesh, uvs.corners.data(), uvs.pages.data());
        }
        return detail::finish(code, std::move(uvs));
    }
    Result<MeshUvs> instance_uvs(const Scene &scene, std::uint32_t instance) const {
        std::uint32_t mesh = 0;
        MeshView view;
        bk_result code = bk_scene_get_instance(scene.get(), instance, &mesh, nullptr);
        if (code == BK_OK)
            code = bk_scene_get_mesh(scene.get(), mesh, &view);
        MeshUvs uvs;
        if (code == BK_OK) {
            uvs.corners.resize(6 * view.triangle_count);
            uvs.pages.resize(view.triangle_count);
            code = bk_lightmap_instance_uvs(get(), instance, uvs.corners.data(), uvs.pages.data());
        }
        return detail::finish(code, std::move(uvs));
    }

    /// A layer of a page as floats: three per texel, one in BK_LAYER_VALIDITY.
    Result<std::vector<float>> read(std::uint32_t page, std::uint32_t layer = BK_LAYER_COMBINED) const {
        std::vector<float> texels;
        const std::size_t channels = layer == BK_LAYER_VALIDITY ? 1 : 3;
        LightmapInfo info;
        bk_result code = bk_lightmap_get_info(get(), &info);
        if (code == BK_OK) {
            texels.resize(channels * info.width * info.height);
            code = bk_lightmap_read(get(), page, layer, channels == 1 ? BK_FORMAT_R32F : BK_FORMAT_RGB32F, texels.data(), 0);
        }
        return detail::finish(code, std::move(texels));
    }
    /// Reads into memory of the caller's, rows packed. `out` must hold `height` rows of a page.
    Result<void> read(std::uint32_t page, std::uint32_t layer, std::uint32_t format, Span<std::byte> out) const {
        LightmapInfo info;
        const bk_result code = bk_lightmap_get_info(get(), &info);
        if (code != BK_OK)
            return detail::finish(code);
        const std::size_t bytes = format == BK_FORMAT_RGB32F ? 12 : format == BK_FORMAT_RGBA16F ? 8 : 4;
        if (out.size() != bytes * info.width * info.height)
            return detail::finish(BK_ERROR_INVALID_ARGUMENT, "the memory is not as large as a page of this format");
        return detail::finish(bk_lightmap_read(get(), page, layer, format, out.data(), 0));
    }
    /// Replaces layers; `texels` holds all pages of the first, then those of the next, three floats per texel.
    Result<void> write(Span<const std::uint32_t> layers, Span<const float> texels, const Progress &progress = {}) {
        LightmapInfo info;
        const bk_result code = bk_lightmap_get_info(get(), &info);
        if (code != BK_OK)
            return detail::finish(code);
        if (texels.size() != layers.size() * info.page_count * info.width * info.height * 3)
            return detail::finish(BK_ERROR_INVALID_ARGUMENT, "the memory is not as large as the pages of these layers");
        return detail::finish(progress.after(bk_lightmap_write(get(), layers.data(), layers.size(), BK_FORMAT_RGB32F,
                                                               texels.data(), progress.function(), progress.user())));
    }
    Result<void> save(const std::string &prefix, std::uint32_t file_format, const Progress &progress = {}) const {
        return detail::finish(progress.after(
            bk_lightmap_save(get(), prefix.c_str(), file_format, progress.function(), progress.user())));
    }
};

/// Light that is refined while a camera moves.
class Live : public Handle<bk_live, bk_live_retain, bk_live_release> {
public:
    using Handle::Handle;
    static Result<Live> create(const Lightmap &map, const LiveParams &params = {}, const Progress &progress = {}) {
        bk_live *out = nullptr;
        const bk_result code = bk_live_create(map.get(), &params, progress.function(), progress.user(), &out);
        Live live(out);
        return detail::finish(progress.after(code), std::move(live));
    }
    /// Live light of a scene that was described anew, with the parameters and, where it stays, the light of that before.
    static Result<Live> create_from(const Lightmap &map, const Live &earlier, float keep_error,
                                    const Progress &progress = {}) {
        bk_live *out = nullptr;
        const bk_result code =
            bk_live_create_from(map.get(), earlier.get(), keep_error, progress.function(), progress.user(), &out);
        Live live(out);
        return detail::finish(progress.after(code), std::move(live));
    }
    Result<LiveStats> update(const Camera &camera, const Budget &budget = {}) {
        LiveStats stats;
        return detail::finish(bk_live_update(get(), &camera, &budget, &stats), stats);
    }
    /// The rectangles that have changed since they were last fetched, as far as the last update's budget lets them out.
    Result<std::vector<bk_rect>> dirty_rects() {
        std::vector<bk_rect> rects;
        bk_result code = BK_OK;
        std::size_t fetched = 0, found = 0;
        do {
            rects.resize(fetched + 256);
            code = bk_live_dirty_rects(get(), rects.data() + fetched, 256, &found);
            fetched += code == BK_OK ? found : 0;
        } while (code == BK_OK && found == 256);
        rects.resize(fetched);
        return detail::finish(code, std::move(rects));
    }
    /// A rectangle of a layer into memory of the caller's, rows packed, `format` RGB32F, RGBA16F or RGBA8.
    Result<void> read(const bk_rect &rect, std::uint32_t layer, std::uint32_t format, Span<std::byte> out) const {
        const std::size_t bytes = format == BK_FORMAT_RGB32F ? 12 : format == BK_FORMAT_RGBA16F ? 8 : 4;
        if (out.size() != bytes * rect.width * rect.height)
            return detail::finish(BK_ERROR_INVALID_ARGUMENT, "the memory is not as large as the rectangle");
        return detail::finish(bk_live_read(get(), rect.page, rect.lod, layer, format, &rect, out.data(), 0));
    }
    Result<void> light_changed(std::uint32_t light) { return detail::finish(bk_live_light_changed(get(), light)); }
    /// Follows the scene after the light map that it was created from has.
    Result<void> follow(const Lightmap &map, float keep_error = 0.03f, const Progress &progress = {}) {
        return detail::finish(
            progress.after(bk_live_follow(get(), map.get(), keep_error, progress.function(), progress.user())));
    }
    Result<void> pause(bool paused) { return detail::finish(bk_live_pause(get(), paused)); }
};

} // namespace bakelite

#endif // BAKELITE_HPP
