#include "dispatch.h"
#include "splat/kernels.h"

namespace avatar::splat {
AVATAR_DEFINE_SELECT_KERNELS
}  // namespace avatar::splat
