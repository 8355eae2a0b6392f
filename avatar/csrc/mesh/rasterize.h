#pragma once
#include <cstdint>

namespace avatar {

// Z-buffered triangle rasterisation at pixel centres (x + 0.5, y + 0.5), without clipping: a triangle with a vertex
// at depth <= 0 or a non-finite coordinate is left out. Both windings are drawn. Pixels without a triangle get
// face -1 and zeros. Ties in depth go to the lower face index, so the result does not depend on anything but the input.
//
//   screen  [vertices * 3]  x and y in pixels, z depth (> 0); barycentrics are perspective-correct in z
//   faces   [num_faces * 3] vertex indices, in range
//   face_id [height * width], barycentric [height * width * 3], depth [height * width]  outputs
void rasterize_mesh(const float* screen, const std::int32_t* faces, std::int64_t num_faces, int height, int width,
                    std::int32_t* face_id, float* barycentric, float* depth);

}  // namespace avatar
