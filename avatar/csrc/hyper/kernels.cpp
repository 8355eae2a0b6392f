// Compiled once for each instruction set; AVATAR_KERNELS says which.
#include "hyper/condition.h"
#include "hyper/folded.h"
#include "hyper/interpolate.h"

namespace avatar::hyper {

extern const Kernels AVATAR_KERNELS;
const Kernels AVATAR_KERNELS = {forward, backward, apply, interpolate, interpolate_backward};

}  // namespace avatar::hyper
