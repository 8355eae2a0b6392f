"""Sculpt the mesh of the demo head again and write avatar/demo/head_mesh.npz: python scripts/make_demo_mesh.py.

tests/demo/test_mesh_file.py says whether the file is what this makes.
"""

from __future__ import annotations

import numpy as np
from demo_mesh.topology import build_head_mesh

from avatar.demo.mesh import MESH_FILE

if __name__ == "__main__":
    np.savez_compressed(MESH_FILE, **build_head_mesh()._asdict())
