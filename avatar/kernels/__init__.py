"""Kernels of the GPU backend in Triton's language, and how they are started.

Importing this package needs no Triton, its modules do. All of them start through `avatar.kernels.launch`, so that one place
counts the launches, and leaves them out on torch's meta device, where tensors have shapes only.
"""
