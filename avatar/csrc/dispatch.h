#pragma once

#include "instruction_set.h"

// Every operator has a table `Kernels` of functions, built once for each instruction set (add_kernels in CMakeLists.txt).
// Written inside an operator's namespace this defines `const Kernels& select_kernels(const char* name)`, which takes what
// choose_instruction_set takes.
#ifdef AVATAR_X86_KERNELS
#define AVATAR_DEFINE_SELECT_KERNELS                            \
    extern const Kernels kernels_baseline;                      \
    extern const Kernels kernels_avx2;                          \
    extern const Kernels kernels_avx512;                        \
    const Kernels& select_kernels(const char* name) {           \
        switch (::avatar::choose_instruction_set(name)) {       \
            case ::avatar::InstructionSet::avx512: return kernels_avx512; \
            case ::avatar::InstructionSet::avx2: return kernels_avx2;     \
            default: return kernels_baseline;                   \
        }                                                       \
    }
#else
#define AVATAR_DEFINE_SELECT_KERNELS                            \
    extern const Kernels kernels_baseline;                      \
    const Kernels& select_kernels(const char* name) {           \
        ::avatar::choose_instruction_set(name);                 \
        return kernels_baseline;                                \
    }
#endif
