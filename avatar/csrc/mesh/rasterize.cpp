#include "mesh/rasterize.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace avatar {

void rasterize_mesh(const float* screen, const std::int32_t* faces, std::int64_t num_faces, int height, int width,
                    std::int32_t* face_id, float* barycentric, float* depth) {
    const std::int64_t pixels = static_cast<std::int64_t>(height) * width;
    std::fill_n(face_id, pixels, -1);
    std::fill_n(barycentric, pixels * 3, 0.0f);
    std::fill_n(depth, pixels, std::numeric_limits<float>::infinity());

    for (std::int64_t f = 0; f < num_faces; ++f) {
        double x[3], y[3], inv_z[3];
        bool drawable = true;
        for (int k = 0; k < 3; ++k) {
            const float* v = screen + 3 * static_cast<std::int64_t>(faces[3 * f + k]);
            drawable &= std::isfinite(v[0]) && std::isfinite(v[1]) && std::isfinite(v[2]) && v[2] > 0.0f;
            x[k] = v[0], y[k] = v[1], inv_z[k] = 1.0 / v[2];
        }
        if (!drawable) continue;
        const double area = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0]);
        if (area == 0.0) continue;

        // Pixel i covers the centre i + 0.5; clamp in double before the conversion, so that huge coordinates are safe.
        const auto bound = [](double value, int limit) {
            return static_cast<int>(std::min(std::max(value, 0.0), static_cast<double>(limit)));
        };
        const int x0 = bound(std::ceil(std::min({x[0], x[1], x[2]}) - 0.5), width);
        const int x1 = bound(std::floor(std::max({x[0], x[1], x[2]}) - 0.5) + 1.0, width);
        const int y0 = bound(std::ceil(std::min({y[0], y[1], y[2]}) - 0.5), height);
        const int y1 = bound(std::floor(std::max({y[0], y[1], y[2]}) - 0.5) + 1.0, height);

        const double inv_area = 1.0 / area;
        for (int py = y0; py < y1; ++py) {
            for (int px = x0; px < x1; ++px) {
                const double cx = px + 0.5, cy = py + 0.5;
                const double b0 = ((x[1] - cx) * (y[2] - cy) - (x[2] - cx) * (y[1] - cy)) * inv_area;
                const double b1 = ((x[2] - cx) * (y[0] - cy) - (x[0] - cx) * (y[2] - cy)) * inv_area;
                const double b2 = std::max(1.0 - b0 - b1, 0.0);
                // By its sign, not by that of b2: the rounding of b2 leaves holes between two triangles.
                const double e2 = ((x[0] - cx) * (y[1] - cy) - (x[1] - cx) * (y[0] - cy)) * inv_area;
                if (b0 < 0.0 || b1 < 0.0 || e2 < 0.0) continue;
                const double w0 = b0 * inv_z[0], w1 = b1 * inv_z[1], w2 = b2 * inv_z[2];
                const double z = 1.0 / (w0 + w1 + w2);
                const std::int64_t p = static_cast<std::int64_t>(py) * width + px;
                if (!(static_cast<float>(z) < depth[p])) continue;
                depth[p] = static_cast<float>(z);
                face_id[p] = static_cast<std::int32_t>(f);
                barycentric[3 * p + 0] = static_cast<float>(w0 * z);
                barycentric[3 * p + 1] = static_cast<float>(w1 * z);
                barycentric[3 * p + 2] = static_cast<float>(w2 * z);
            }
        }
    }
    for (std::int64_t p = 0; p < pixels; ++p)
        if (face_id[p] < 0) depth[p] = 0.0f;
}

}  // namespace avatar
