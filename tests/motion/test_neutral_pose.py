from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch
from heads import BROWS, OPEN, SMILE, grid_head, mouth_head, random_params, rest_params

from avatar.errors import UserError
from avatar.head.model import HeadModel, matrix_from_6d
from avatar.motion import neutral_pose
from avatar.motion.neutral_pose import LIPS_OPEN, chosen_frame, closed_frames, find_neutral, frame_rest, lips_apart
from avatar.types import HeadParams

HEAD = HeadModel(mouth_head(), torch.zeros(0))


def frame(opening: float = 0.0, smile: float = 0.0, brows: float = 0.0, wobble: float = 0.0) -> HeadParams:
    expression = torch.zeros(3)
    expression[[OPEN, SMILE, BROWS]] = torch.tensor([opening, smile, brows]) + wobble * torch.randn(3)
    return replace(rest_params(3), expression=expression, eyelids=torch.rand(2))


def talkative() -> list[HeadParams]:
    """Mostly lips 4 mm apart and nothing else moved; smiles with closed lips; ten frames at rest; lively ones."""
    open_mouth = [frame(opening=0.4, wobble=0.002) for _ in range(150)]
    smiling = [frame(smile=1.0 + 0.1 * i, wobble=0.002) for i in range(20)]
    at_rest = [frame(brows=0.1, wobble=0.002) for _ in range(10)]
    lively = [frame(opening=1.0, smile=1.0, brows=1.0, wobble=0.3) for _ in range(20)]
    return [*open_mouth, *smiling, *at_rest, *lively]


def test_the_neutral_of_a_driver_who_speaks_all_the_time_has_closed_lips() -> None:
    motion = talkative()
    neutral = find_neutral(motion, HEAD)
    assert neutral.frame is not None and 170 <= neutral.frame < 180, "neither open, nor smiling"
    apart = lips_apart(neutral, HEAD)
    assert apart is not None and apart < 0.0005
    assert float(neutral.expression[BROWS]) == pytest.approx(0.1, abs=0.01)
    assert float(neutral.expression[SMILE].abs()) < 0.01


def test_without_lips_it_is_the_pose_that_a_calm_face_comes_back_to_most() -> None:
    blind = HeadModel(replace(mouth_head(), regions={}), torch.zeros(0))
    motion = talkative()
    assert lips_apart(find_neutral(motion, blind), blind) is None
    # Ten frames at rest and 30 with little more: of the calmest 40 (20%), the larger group is denser.
    calm = [*motion[170:180], *(frame(brows=0.2, wobble=0.0001) for _ in range(30)), *motion[180:200] * 8]
    neutral = find_neutral(calm, blind)
    assert neutral.frame is not None and 10 <= neutral.frame < 40


@pytest.mark.parametrize("height", [0.0, -1.0])
def test_a_fifth_of_the_frames_counts_as_calm(height: float) -> None:
    """Brows higher and higher in a hundred frames, the denser the higher: of the lowest twenty the last two are nearest to
    each other."""
    lift = 1 - torch.linspace(1, 0, 100).square()
    face = mouth_head()
    head = HeadModel(replace(face, template=face.template + torch.tensor([0.0, height, 0.0])), torch.zeros(0))
    assert find_neutral([frame(brows=float(value)) for value in lift], head).frame == 18


def test_a_person_whose_tracking_leaves_a_gap_has_closed_lips_too() -> None:
    gap = torch.tensor([0.004, 0.0042, 0.0054, 0.0056, 0.02] * 40)
    assert sorted({round(float(gap[i]), 4) for i in closed_frames(gap)}) == [0.004, 0.0042, 0.0054]
    pressed = torch.tensor([-0.002] * 10 + [0.0014] * 50 + [0.002] * 40)
    assert len(closed_frames(pressed)) == 60, "lips that are pressed together do not make closed ones open"


def test_a_single_closed_frame_of_many_is_an_error_of_tracking() -> None:
    gap = torch.cat((torch.tensor([0.0]), torch.full((199,), 0.003)))
    assert len(closed_frames(gap)) == 200


def test_lips_are_never_closed_is_known() -> None:
    motion = [frame(opening=0.5 + 0.01 * (i % 7)) for i in range(60)]
    apart = lips_apart(find_neutral(motion, HEAD), HEAD)
    assert apart is not None and apart > LIPS_OPEN


def test_lips_that_are_ajar_on_the_head_model_itself_are_closed() -> None:
    face = mouth_head()
    ajar = HeadModel(replace(face, template=face.template + 0.1 * face.expression_dirs[:, :, OPEN]), torch.zeros(0))
    assert lips_apart(frame_rest([frame()], 0), ajar) == pytest.approx(0.0, abs=1e-6)
    assert lips_apart(frame_rest([frame(opening=0.2)], 0), ajar) == pytest.approx(0.002, abs=2e-4)


def test_one_frame_is_its_own_neutral() -> None:
    neutral = find_neutral([frame(opening=0.3)], HEAD)
    assert neutral.frame == 0 and float(neutral.expression[OPEN]) == pytest.approx(0.3)


def test_gaze_blinks_and_neck_do_not_count() -> None:
    motion = talkative()
    generator = torch.Generator().manual_seed(3)
    moved = [
        replace(params, eyes=torch.randn(12, generator=generator), neck=random_params(i).neck, eyelids=torch.ones(2))
        for i, params in enumerate(motion)
    ]
    assert find_neutral(moved, HEAD).frame == find_neutral(motion, HEAD).frame


def test_a_long_video_is_compared_with_a_bounded_number_of_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes: list[int] = []
    real = torch.cdist

    def counting(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        sizes.append(len(a))
        return real(a, b)

    monkeypatch.setattr(torch, "cdist", counting)
    monkeypatch.setattr(neutral_pose, "CALM_MOST", 9)
    neutral = find_neutral([frame(wobble=0.01) for _ in range(100)], HEAD)
    assert sizes[0] <= 9 and neutral.frame is not None


def test_batches_pose_heads_as_single_frames_do() -> None:
    """A random head, with pose correctives and weights of all joints, in both precisions."""
    for dtype in (torch.float32, torch.float64):
        head = HeadModel(grid_head(), torch.tensor([0.5, -1.0]), dtype)
        poses = [replace(random_params(seed), eyelids=torch.zeros(2)) for seed in range(5)]
        still = [replace(p, eyes=rest_params().eyes, neck=rest_params().neck) for p in poses]
        expected = torch.stack([head.vertices(p) for p in still])
        rows = torch.tensor([3, 0, 62, 17])
        expression, jaw = (
            torch.stack([p.expression for p in poses]),
            matrix_from_6d(torch.stack([p.jaw for p in poses])),
        )
        torch.testing.assert_close(head.still_vertices(expression, jaw, rows), expected[:, rows], rtol=0, atol=1e-6)
    fewer = head.still_vertices(expression[:, :2], jaw, rows)
    padded = head.still_vertices(torch.cat((expression[:, :2], torch.zeros(5, 3)), dim=1), jaw, rows)
    torch.testing.assert_close(fewer, padded)
    with pytest.raises(ValueError, match="expression has 6 coefficients, but the head model has 5 directions"):
        head.still_vertices(torch.zeros(5, 6), jaw, rows)


def test_what_the_jaw_carries_turns_with_it() -> None:
    """Eyes that hang on the jaw: no head has that, and a kinematic tree may say so."""
    head = HeadModel(replace(grid_head(), parents=(-1, 0, 1, 2, 2)), torch.zeros(0))
    params = replace(random_params(1), eyes=rest_params().eyes, neck=rest_params().neck, eyelids=torch.zeros(2))
    rows = torch.arange(63)
    found = head.still_vertices(params.expression[None], matrix_from_6d(params.jaw)[None], rows)[0]
    torch.testing.assert_close(found, head.vertices(params), rtol=0, atol=1e-6)


NAMES: Sequence[str] = ("00001", "00007", "00012", "frame_a")


@pytest.mark.parametrize(("wanted", "position"), [("00007", 1), ("7", 1), ("12", 2), ("0012", 2), ("frame_a", 3)])
def test_a_frame_is_chosen_by_its_name_or_number(wanted: str, position: int) -> None:
    assert chosen_frame(wanted, NAMES, "anna") == position
    motion = [frame(opening=0.1 * i) for i in range(4)]
    chosen = frame_rest(motion, position)
    assert torch.equal(chosen.expression, motion[position].expression) and chosen.frame == position
    assert torch.equal(chosen.jaw, matrix_from_6d(motion[position].jaw))


@pytest.mark.parametrize("wanted", ["3", "00003", "", "-1", "²", "frame"])
def test_a_frame_that_there_is_not_is_refused_with_those_that_there_are(wanted: str) -> None:
    with pytest.raises(UserError, match="anna has no frame .* there are 00001 to frame_a .4 frames."):
        chosen_frame(wanted, NAMES, "anna")
