#include "dispatch.h"
#include "compose/compose.h"

namespace avatar::compose {
AVATAR_DEFINE_SELECT_KERNELS
}  // namespace avatar::compose
