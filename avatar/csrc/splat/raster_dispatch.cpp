#include "dispatch.h"
#include "splat/raster.h"

namespace avatar::splat {
AVATAR_DEFINE_SELECT_KERNELS
}  // namespace avatar::splat
