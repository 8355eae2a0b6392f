#include "dispatch.h"
#include "apply_offsets/apply_offsets.h"

namespace avatar::apply_offsets {
AVATAR_DEFINE_SELECT_KERNELS
}  // namespace avatar::apply_offsets
