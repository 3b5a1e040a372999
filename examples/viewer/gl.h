// OpenGL 3.3 as gl::Name, its functions found at run time through GLFW; programs and textures.
#pragma once

#define GLFW_INCLUDE_GLCOREARB
#define GL_GLEXT_PROTOTYPES // for the types of the functions; the functions themselves are not linked
#include <GLFW/glfw3.h>

// Those that the viewer calls, without their prefix.
#define GL_FUNCTIONS(X) \
    X(ActiveTexture) X(AttachShader) X(BindBuffer) X(BindFramebuffer) X(BindTexture) X(BindVertexArray) X(BlendFunc) \
    X(BufferData) X(CheckFramebufferStatus) X(Clear) X(ClearColor) X(ClearDepth) X(CompileShader) X(CreateProgram) \
    X(CreateShader) X(DeleteShader) X(DepthFunc) X(Disable) X(DrawArrays) X(DrawBuffer) X(Enable) \
    X(EnableVertexAttribArray) X(Finish) X(FramebufferTexture2D) X(FramebufferTextureLayer) X(GenBuffers) \
    X(GenFramebuffers) X(GenTextures) X(GenVertexArrays) X(GetIntegerv) X(GetProgramInfoLog) X(GetProgramiv) \
    X(GetShaderInfoLog) X(GetShaderiv) X(GetTexImage) X(GetUniformLocation) X(LinkProgram) X(PixelStorei) \
    X(PolygonOffset) X(ReadBuffer) X(ReadPixels) X(ShaderSource) X(TexImage2D) X(TexImage3D) \
    X(TexParameteri) X(TexSubImage3D) X(Uniform1f) X(Uniform1i) X(Uniform2f) X(Uniform2iv) X(Uniform3fv) \
    X(Uniform4fv) X(UniformMatrix4fv) X(UseProgram) X(VertexAttribIPointer) X(VertexAttribPointer) \
    X(Viewport)

namespace gl {

#define X(name) extern decltype(&::gl##name) name;
GL_FUNCTIONS(X)
#undef X

// Finds the functions in the current context; throws if one is not there.
void load();

class Program {
public:
    // Throws the compiler's message.
    Program(const char *vertex, const char *fragment);
    void use() const { UseProgram(id); }
    // The place of a uniform; -1, which OpenGL ignores, where the program has none of this name.
    GLint operator[](const char *uniform) const { return GetUniformLocation(id, uniform); }

private:
    GLuint id;
};

// Like all objects here, textures live as long as the context.
GLuint make_texture(GLenum target, GLint filter);
// Allocates a texture of one level; depth 0 makes it two-dimensional.
void allocate(GLenum target, GLint internal, int width, int height, int depth, GLenum format, GLenum type,
              const void *data);
void bind_texture(int unit, GLenum target, GLuint texture);

} // namespace gl
