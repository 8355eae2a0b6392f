// Compiled once for each instruction set; AVATAR_KERNELS says which.
#include "splat/kernels.h"

#include "splat/features_backward.h"
#include "splat/features_forward.h"
#include "splat/project_batches.h"
#include "splat/project_forward.h"
#include "splat/raster_backward.h"
#include "splat/raster_forward.h"

namespace avatar::splat {

extern const Kernels AVATAR_KERNELS;
const Kernels AVATAR_KERNELS = {kWords,           all_finite,    project,
                                project_backward, forward_tile,  backward_tile,
                                project_backward_features, feature_workspace, forward_features, backward_features};

}  // namespace avatar::splat
