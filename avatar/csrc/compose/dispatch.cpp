#include "compose/compose.h"
#include "instruction_set.h"

namespace avatar::compose {

extern const Kernels kernels_baseline;
#ifdef AVATAR_X86_KERNELS
extern const Kernels kernels_avx2;
extern const Kernels kernels_avx512;
#endif

const Kernels& select_kernels(const char* name) {
    switch (choose_instruction_set(name)) {
#ifdef AVATAR_X86_KERNELS
        case InstructionSet::avx512:
            return kernels_avx512;
        case InstructionSet::avx2:
            return kernels_avx2;
#endif
        default:
            return kernels_baseline;
    }
}

}  // namespace avatar::compose
