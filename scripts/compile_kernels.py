"""Compile every GPU kernel ahead of time, for targets that this machine need not have, and say what each one takes.

    python scripts/compile_kernels.py [--out docs/bench/gpu_kernels.md] [--target sm_90 ...]

What is compiled is what the program starts: drawings and training steps run on torch's meta device, where a start is noted
and nothing computed. Ends with status 1 when a kernel does not compile or spills registers.
"""
