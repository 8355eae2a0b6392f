// Compiled once for each instruction set; AVATAR_KERNELS and AVATAR_KERNELS_NAME say which.
#include "splat/raster_backward.h"
#include "splat/raster_forward.h"

namespace avatar::splat {

extern const Kernels AVATAR_KERNELS;
const Kernels AVATAR_KERNELS = {AVATAR_KERNELS_NAME, forward_tile, backward_tile};

}  // namespace avatar::splat
