"""The mesh that the program has is the one that scripts/make_demo_mesh.py sculpts."""

from __future__ import annotations

import numpy as np
import pytest
from demo_mesh.topology import build_head_mesh

from avatar.demo.mesh import load_head_mesh


@pytest.mark.slow
def test_the_file_holds_what_the_script_makes() -> None:
    made, stored = build_head_mesh(), load_head_mesh()
    for name, values in made._asdict().items():
        found = getattr(stored, name)
        assert found.dtype == values.dtype, name
        np.testing.assert_allclose(found, values, rtol=0, atol=1e-9, err_msg=name)
