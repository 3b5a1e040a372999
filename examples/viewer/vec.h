// As much vector algebra as the viewer needs. Matrices are column-major, as OpenGL takes them.
#pragma once

#include <array>
#include <cmath>

struct Vec3 {
    float x = 0, y = 0, z = 0;
    float &operator[](int i) { return i == 0 ? x : i == 1 ? y : z; }
    float operator[](int i) const { return i == 0 ? x : i == 1 ? y : z; }
};

inline Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vec3 operator-(Vec3 a, Vec3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vec3 operator*(float s, Vec3 a) { return {s * a.x, s * a.y, s * a.z}; }
inline float dot(Vec3 a, Vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline float length(Vec3 a) { return std::sqrt(dot(a, a)); }
inline Vec3 normalize(Vec3 a) { return 1.0f / length(a) * a; }
inline Vec3 cross(Vec3 a, Vec3 b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

using Mat4 = std::array<float, 16>;

inline Mat4 operator*(const Mat4 &a, const Mat4 &b) {
    Mat4 m{};
    for (int column = 0; column < 4; column++) {
        for (int row = 0; row < 4; row++) {
            for (int k = 0; k < 4; k++) m[4 * column + row] += a[4 * k + row] * b[4 * column + k];
        }
    }
    return m;
}

// From the scene to an eye that looks along its -z axis.
inline Mat4 look_at(Vec3 eye, Vec3 forward, Vec3 up) {
    const Vec3 f = normalize(forward), r = normalize(cross(f, up)), u = cross(r, f);
    return {r.x, u.x, -f.x, 0, r.y, u.y, -f.y, 0, r.z, u.z, -f.z, 0, -dot(r, eye), -dot(u, eye), dot(f, eye), 1};
}

inline Mat4 perspective(float fov_y, float aspect, float near, float far) {
    const float s = 1 / std::tan(fov_y / 2);
    return {s / aspect, 0, 0, 0, 0, s, 0, 0, 0, 0, (near + far) / (near - far), -1, 0, 0, 2 * near * far / (near - far),
            0};
}

// A box as wide and as high as twice `half`.
inline Mat4 orthographic(float half, float near, float far) {
    return {1 / half, 0, 0, 0, 0, 1 / half, 0, 0, 0, 0, 2 / (near - far), 0, 0, 0, (near + far) / (near - far), 1};
}
