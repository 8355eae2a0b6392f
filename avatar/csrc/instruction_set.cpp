#include "instruction_set.h"

#include <stdexcept>
#include <string>

namespace avatar {

InstructionSet choose_instruction_set(const char* name) {
    const std::string wanted = name;
#ifdef AVATAR_X86_KERNELS
    const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
    const bool avx512 = avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
                        __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512bw");
    if (avx512 && (wanted.empty() || wanted == "avx512")) return InstructionSet::avx512;
    if (avx2 && (wanted.empty() || wanted == "avx2")) return InstructionSet::avx2;
#endif
    if (wanted.empty() || wanted == "baseline") return InstructionSet::baseline;
    if (wanted == "avx2" || wanted == "avx512")
        throw std::invalid_argument("AVATAR_SIMD=" + wanted +
                                    " asks for instructions that this processor does not have");
    throw std::invalid_argument("AVATAR_SIMD must be baseline, avx2 or avx512, got " + wanted);
}

}  // namespace avatar
