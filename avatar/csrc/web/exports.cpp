// What JavaScript calls. One avatar at a time; numbers and addresses only.
#include <emscripten/emscripten.h>

#include <memory>
#include <new>

#include "web/portrait.h"

namespace {

std::unique_ptr<avatar::web::Portrait> portrait;
std::unique_ptr<std::uint8_t[]> picture;
std::int64_t picture_pixels = 0;
double camera_values[18];  // rotation 9, translation 3, fx, fy, cx, cy, width, height
float background[3] = {1, 1, 1};
constexpr std::int32_t kMaxSide = 4096;

}  // namespace

extern "C" {

// 0 when the sizes are absurd. Compiled without exceptions: what throws, for want of memory too, ends the module.
EMSCRIPTEN_KEEPALIVE int avatar_create(int vertices, int expressions, int gaussians, int nodes, int latent, int width,
                                       int layers, int coefficients, int has_grid, int has_heads) {
    for (const int size : {vertices, gaussians, nodes, latent, width, layers, coefficients})
        if (size < 1 || size > 1 << 20) return 0;
    if (expressions < 0 || expressions > 4096 || coefficients > 16 || (!has_heads && latent != 10)) return 0;
    if (!has_grid && nodes != gaussians) return 0;
    portrait.reset(new avatar::web::Portrait(
        {vertices, expressions, gaussians, nodes, latent, width, layers, coefficients, has_grid, has_heads}));
    return 1;
}
EMSCRIPTEN_KEEPALIVE float* avatar_array(int which) { return portrait->array(which); }
EMSCRIPTEN_KEEPALIVE double avatar_length(int which) { return static_cast<double>(portrait->length(which)); }
EMSCRIPTEN_KEEPALIVE std::int32_t* avatar_corners() { return portrait->corners(); }
EMSCRIPTEN_KEEPALIVE std::int32_t* avatar_cells() { return portrait->cells(); }
EMSCRIPTEN_KEEPALIVE std::int32_t* avatar_parents() { return portrait->parents; }
EMSCRIPTEN_KEEPALIVE float* avatar_parameters() { return portrait->parameters(); }
EMSCRIPTEN_KEEPALIVE double* avatar_camera() { return camera_values; }
EMSCRIPTEN_KEEPALIVE float* avatar_background() { return background; }
EMSCRIPTEN_KEEPALIVE int avatar_is_sound() { return portrait->is_sound(); }
EMSCRIPTEN_KEEPALIVE void avatar_pose() { portrait->pose(); }

// The picture's address, or null when it cannot be drawn.
EMSCRIPTEN_KEEPALIVE std::uint8_t* avatar_draw() {
    avatar::splat::Camera camera{};
    std::copy(camera_values, camera_values + 9, camera.rotation);
    std::copy(camera_values + 9, camera_values + 12, camera.translation);
    camera.fx = camera_values[12], camera.fy = camera_values[13];
    camera.cx = camera_values[14], camera.cy = camera_values[15];
    const double width = camera_values[16], height = camera_values[17];
    if (!(width >= 1 && width <= kMaxSide && height >= 1 && height <= kMaxSide)) return nullptr;
    camera.width = static_cast<int>(width), camera.height = static_cast<int>(height);
    const std::int64_t pixels = std::int64_t{camera.width} * camera.height;
    if (pixels > picture_pixels) {
        picture.reset(new (std::nothrow) std::uint8_t[pixels * 4]);
        picture_pixels = picture ? pixels : 0;
        if (!picture) return nullptr;
    }
    return portrait->draw(camera, background, picture.get()) ? picture.get() : nullptr;
}

EMSCRIPTEN_KEEPALIVE const float* avatar_means() { return portrait->means(); }
EMSCRIPTEN_KEEPALIVE const float* avatar_quats() { return portrait->quats(); }
EMSCRIPTEN_KEEPALIVE const float* avatar_scales() { return portrait->scales(); }
EMSCRIPTEN_KEEPALIVE const float* avatar_opacities() { return portrait->opacities(); }

}  // extern "C"
