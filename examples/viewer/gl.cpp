#include "gl.h"

#include <stdexcept>
#include <string>

namespace gl {

#define X(name) decltype(&::gl##name) name;
GL_FUNCTIONS(X)
#undef X

void load() {
#define X(name) \
    name = reinterpret_cast<decltype(name)>(glfwGetProcAddress("gl" #name)); \
    if (!name) throw std::runtime_error("OpenGL has no gl" #name);
    GL_FUNCTIONS(X)
#undef X
}

Program::Program(const char *vertex, const char *fragment) : id(CreateProgram()) {
    std::string log(10000, 0);
    GLint fine = 0;
    const auto attach = [&](GLenum kind, const char *source) {
        const GLuint shader = CreateShader(kind);
        ShaderSource(shader, 1, &source, nullptr);
        CompileShader(shader);
        GetShaderiv(shader, GL_COMPILE_STATUS, &fine);
        if (!fine) {
            GetShaderInfoLog(shader, GLsizei(log.size()), nullptr, &log[0]);
            throw std::runtime_error("a shader is not accepted: " + log);
        }
        AttachShader(id, shader);
        DeleteShader(shader);
    };
    attach(GL_VERTEX_SHADER, vertex);
    attach(GL_FRAGMENT_SHADER, fragment);
    LinkProgram(id);
    GetProgramiv(id, GL_LINK_STATUS, &fine);
    if (!fine) {
        GetProgramInfoLog(id, GLsizei(log.size()), nullptr, &log[0]);
        throw std::runtime_error("a program is not accepted: " + log);
    }
}

void bind_texture(int unit, GLenum target, GLuint texture) {
    ActiveTexture(GL_TEXTURE0 + GLenum(unit));
    BindTexture(target, texture);
}

GLuint make_texture(GLenum target, GLint filter) {
    GLuint texture;
    GenTextures(1, &texture);
    BindTexture(target, texture);
    TexParameteri(target, GL_TEXTURE_MIN_FILTER, filter);
    TexParameteri(target, GL_TEXTURE_MAG_FILTER, filter);
    TexParameteri(target, GL_TEXTURE_WRAP_S, GL_CLAMP_TO_EDGE);
    TexParameteri(target, GL_TEXTURE_WRAP_T, GL_CLAMP_TO_EDGE);
    TexParameteri(target, GL_TEXTURE_MAX_LEVEL, 0);
    return texture;
}

void allocate(GLenum target, GLint internal, int width, int height, int depth, GLenum format, GLenum type,
              const void *data) {
    if (depth == 0) TexImage2D(target, 0, internal, width, height, 0, format, type, data);
    else TexImage3D(target, 0, internal, width, height, depth, 0, format, type, data);
}

} // namespace gl
