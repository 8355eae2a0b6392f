#include "dispatch.h"
#include "hyper/kernels.h"

namespace avatar::hyper {
AVATAR_DEFINE_SELECT_KERNELS
}  // namespace avatar::hyper
