"""Sculpts the mesh of the demo head. Not part of the program, which reads the result: avatar/demo/head_mesh.npz."""
