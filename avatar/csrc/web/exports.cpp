// What JavaScript calls. One avatar at a time; numbers and addresses only.
#include <emscripten/emscripten.h>

#include <memory>
#include <new>

#include "web/web_avatar.h"

namespace {

avatar::web::Sizes measured;
std::int64_t lengths[avatar::web::kArrays];
std::unique_ptr<avatar::web::WebAvatar> web_avatar;
std::unique_ptr<std::uint8_t[]> picture;
std::int64_t picture_pixels = 0;
double camera_values[18];  // rotation 9, translation 3, fx, fy, cx, cy, width, height
float background[3] = {1, 1, 1};
constexpr int kMaxSide = 4096;
constexpr std::int64_t kMaxLatents = 1 << 26;  // of all nodes; a number that 32 bits hold, as they are here

avatar::splat::Camera camera_in_pixels() {
    avatar::splat::Camera camera{};
    std::copy(camera_values, camera_values + 9, camera.rotation);
    std::copy(camera_values + 9, camera_values + 12, camera.translation);
    camera.fx = camera_values[12], camera.fy = camera_values[13];
    camera.cx = camera_values[14], camera.cy = camera_values[15];
    const auto side = [](double value) { return value >= 1 && value <= kMaxSide ? static_cast<int>(value) : 0; };
    camera.width = side(camera_values[16]), camera.height = side(camera_values[17]);
    return camera;
}

}  // namespace

extern "C" {

// 0 when the sizes are absurd. Takes no memory: a caller compares the lengths with what it has before it allocates.
EMSCRIPTEN_KEEPALIVE int avatar_measure(int vertices, int expressions, int gaussians, int nodes, int latent, int width,
                                        int layers, int coefficients, int has_grid, int has_heads,
                                        int has_skull_binding, int has_head_rotation) {
    for (const int size : {vertices, gaussians, nodes, latent, width, layers, coefficients})
        if (size < 1 || size > 1 << 20) return 0;
    const bool is_square = coefficients == 1 || coefficients == 4 || coefficients == 9 || coefficients == 16;
    if (expressions < 0 || expressions > 4096 || !is_square || (!has_heads && latent != 10)) return 0;
    if (!has_grid && nodes != gaussians) return 0;
    if (std::int64_t{nodes} * latent > kMaxLatents) return 0;
    measured = {vertices, expressions, gaussians, nodes, latent, width, layers, coefficients,
                has_grid, has_heads, has_skull_binding, has_head_rotation};
    avatar::web::array_lengths(measured, lengths);
    return 1;
}
// How many values an array of the measured sizes has.
EMSCRIPTEN_KEEPALIVE double avatar_length(int which) {
    return which >= 0 && which < avatar::web::kArrays ? static_cast<double>(lengths[which]) : -1.0;
}
// Compiled without exceptions: want of memory ends the module.
EMSCRIPTEN_KEEPALIVE void avatar_create() { web_avatar.reset(new avatar::web::WebAvatar(measured)); }
EMSCRIPTEN_KEEPALIVE float* avatar_array(int which) { return web_avatar->array(which); }
EMSCRIPTEN_KEEPALIVE std::int32_t* avatar_corners() { return web_avatar->corners(); }
EMSCRIPTEN_KEEPALIVE std::int32_t* avatar_cells() { return web_avatar->cells(); }
EMSCRIPTEN_KEEPALIVE std::int32_t* avatar_parents() { return web_avatar->parents; }
EMSCRIPTEN_KEEPALIVE float* avatar_parameters() { return web_avatar->parameters(); }
EMSCRIPTEN_KEEPALIVE float* avatar_head_rotation() { return web_avatar->head_rotation; }
EMSCRIPTEN_KEEPALIVE void avatar_set_blur(double blur) { web_avatar->blur = blur; }
EMSCRIPTEN_KEEPALIVE double* avatar_camera() { return camera_values; }
EMSCRIPTEN_KEEPALIVE float* avatar_background() { return background; }
EMSCRIPTEN_KEEPALIVE int avatar_is_sound() { return web_avatar->is_sound(); }
EMSCRIPTEN_KEEPALIVE void avatar_pose() { web_avatar->pose(); }

// The picture's address, or null when it cannot be drawn.
EMSCRIPTEN_KEEPALIVE std::uint8_t* avatar_draw() {
    const avatar::splat::Camera camera = camera_in_pixels();
    if (camera.width < 1 || camera.width > kMaxSide || camera.height < 1 || camera.height > kMaxSide) return nullptr;
    const std::int64_t pixels = std::int64_t{camera.width} * camera.height;
    if (pixels > picture_pixels) {
        picture.reset(new (std::nothrow) std::uint8_t[pixels * 4]);
        picture_pixels = picture ? pixels : 0;
        if (!picture) return nullptr;
    }
    return web_avatar->draw(camera, background, picture.get()) ? picture.get() : nullptr;
}

// Where the packed Gaussians are.
EMSCRIPTEN_KEEPALIVE const float* avatar_pack() { return web_avatar->pack(camera_in_pixels()); }

}  // extern "C"
