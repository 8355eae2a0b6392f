#pragma once

namespace avatar {

// What the kernels are compiled for, in the order of what a processor must have; CMakeLists.txt has the flags.
enum class InstructionSet { baseline, avx2, avx512 };

// "baseline", "avx2" or "avx512"; "" is the best that this processor has. Throws std::invalid_argument for a name that
// is unknown or that this processor or build does not support.
InstructionSet choose_instruction_set(const char* name);

}  // namespace avatar
