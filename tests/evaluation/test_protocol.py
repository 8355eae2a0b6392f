"""Protocol files: those that come with the program say what they should, and a wrong one gets one sentence."""

from __future__ import annotations

from pathlib import Path

import pytest

from avatar.data.split import Split
from avatar.errors import UserError
from avatar.evaluation.protocol import builtin_protocols, choose_protocols, read_protocol

NAMES = ["hypergaussians", "flashavatar", "insta350", "rgbavatar", "strict"]


def test_the_choices_of_the_protocols_that_come_with_the_program() -> None:
    protocols = choose_protocols(None)
    assert [protocol.name for protocol in protocols] == NAMES
    by_name = {protocol.name: protocol for protocol in protocols}
    white, green, black = (1.0, 1.0, 1.0), (0.0, 1.0, 0.0), (0.0, 0.0, 0.0)
    assert [p.background for p in protocols] == [white, green, white, black, white]
    assert [p.mask for p in protocols] == ["multiply", "none", "none", "none", "none"]
    assert [p.frames for p in protocols] == ["held-out", "held-out", 350, 350, "held-out"]
    assert {(p.clamp, p.levels, p.lpips_net, p.lpips_scale) for p in protocols} == {(True, "round", "vgg", 1.0)}
    assert by_name["strict"].regions == ("head", "mouth", "eyes", "rest", "head_rim", "neck_rim")
    for protocol in protocols[:-1]:
        assert protocol.regions == ("head", "mouth")
        assert "Known: " in protocol.source and "Our reading: " in protocol.source


def test_frames_are_never_those_of_the_training() -> None:
    by_name = {protocol.name: protocol for protocol in choose_protocols(None)}
    long = Split(tuple(range(500, 2500)), tuple(range(2500, 3000)))
    assert by_name["hypergaussians"].select(range(3000), long) == long.test
    assert by_name["insta350"].select(range(3000), long) == tuple(range(2650, 3000))
    short = Split(tuple(range(800)), tuple(range(800, 1000)))
    assert by_name["insta350"].select(range(1000), short) == short.test
    tiny = Split((0,), (1,))
    assert by_name["insta350"].select(range(2), tiny) == (1,)


def test_the_last_frames_of_several_cameras_are_the_last_times() -> None:
    protocol = read_protocol(builtin_protocols()["insta350"])
    times = [time for time in range(400) for _ in range(3)]  # three cameras
    split = Split(tuple(i for i in range(1200) if i % 3), tuple(range(0, 1200, 3)))  # one of them is held out
    assert protocol.select(times, split) == tuple(range(150, 1200, 3))
    by_camera = [i % 400 for i in range(1200)]  # the pictures of one camera, then those of the next
    assert protocol.select(by_camera, Split(tuple(range(400)), tuple(range(400, 1200)))) == (
        *range(450, 800),
        *range(850, 1200),
    )


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_a_protocol_is_read_as_an_editor_on_windows_saves_it(encoding: str, tmp_path: Path) -> None:
    text = builtin_protocols()["strict"].read_text(encoding="utf-8")
    (tmp_path / "mine.yaml").write_bytes(text.replace("\n", "\r\n").encode(encoding))
    assert read_protocol(tmp_path / "mine.yaml").regions == ("head", "mouth", "eyes", "rest", "head_rim", "neck_rim")


def test_unknown_protocols_are_refused_and_repeated_ones_run_once(tmp_path: Path) -> None:
    assert [protocol.name for protocol in choose_protocols(["insta350", "insta350"])] == ["insta350"]
    with pytest.raises(UserError, match="no protocol 'hyper'; choose from hypergaussians, flashavatar, insta350"):
        choose_protocols(["hyper"])
    text = builtin_protocols()["strict"].read_text()
    for file in ("strict.yaml", "a/mine.yaml", "b/mine.yaml"):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_text(text)
    with pytest.raises(UserError, match=r"strict\.yaml: there is another protocol 'strict' already"):
        choose_protocols([str(tmp_path / "strict.yaml")])
    a, b = str(tmp_path / "a/mine.yaml"), str(tmp_path / "b/mine.yaml")
    assert [protocol.name for protocol in choose_protocols([a, "strict", b])] == ["mine", "strict"]  # they are equal
    (tmp_path / "b/mine.yaml").write_text(text.replace("white\n", "black\n"))
    with pytest.raises(UserError, match=r"b/mine\.yaml: there is another protocol 'mine' already"):
        choose_protocols([a, b])


CHANGES = {
    "an unknown key": (("mask: none", "mask: none\nblur: 2"), "there is no key 'blur'"),
    "a misspelt key": (("levels:", "level:"), "there is no key 'level'; the nearest is 'levels'"),
    "a missing key": (("clamp: true\n", ""), "clamp missing; a protocol names every choice"),
    "a key twice": (("mask: none", "mask: none\nmask: only"), "'mask' stands there twice"),
    "no frames": (("frames: held-out", "frames: 0"), "frames is 0, and has to be held-out, or how many frames"),
    "frames as a flag": (("frames: held-out", "frames: true"), "frames is True"),
    "an unknown colour": (
        ("background: white", "background: purple"),
        "background is 'purple', and has to be a colour: white, black",
    ),
    "two channels": (("background: white", "background: [1, 0]"), "background is [1, 0]"),
    "a colour without quotes": (("background: white", "background: #00ff00"), "and has to be a colour"),
    "a colour out of range": (("background: white", "background: [1, 0, 255]"), "three numbers from 0 to 1"),
    "not a number": (("background: white", "background: [1, 0, .nan]"), "three numbers from 0 to 1"),
    "an unknown mask": (("mask: none", "mask: head"), "mask is 'head', and has to be one of multiply, none, only"),
    "a word for a flag": (("clamp: true", "clamp: often"), "clamp is 'often', and has to be true or false"),
    "unclamped 8 bits": (("clamp: true", "clamp: false"), "clamp: false needs levels: float"),
    "unknown levels": (("levels: round", "levels: [8]"), "levels is [8], and has to be one of round, truncate, float"),
    "an unknown region": (("head_rim, neck_rim]", "nose]"), "'rest', 'nose']"),
    "a region twice": (("mouth, eyes, rest, head_rim, neck_rim]", "head]"), "regions is ['head', 'head']"),
    "a region that is a list": (("[head, mouth, eyes, rest, head_rim, neck_rim]", "[[head]]"), "regions is [['head']]"),
    "an unknown network": (("lpips_net: vgg", "lpips_net: resnet"), "one of vgg, alex, squeeze"),
    "a negative scale": (("lpips_scale: 1.0", "lpips_scale: -1"), "lpips_scale is -1, and has to be a number above 0"),
    "an empty summary": (("summary: ", "summary: ''\n# "), "summary is '', and has to be a sentence"),
    "an object of Python": (
        ("lpips_scale: 1.0", "lpips_scale: !!python/object/apply:os.getcwd []"),
        "cannot be read as YAML",
    ),
    "an alias": (("regions: [head", "regions: &a [*a, head"), "aliases (*name) are not allowed"),
    "depth without end": (("regions: ", "regions: " + "[" * 20000), "cannot be read as YAML"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_wrong_file_gets_one_sentence(change: str, tmp_path: Path) -> None:
    (old, new), sentence = CHANGES[change]
    text = builtin_protocols()["strict"].read_text()
    assert text.count(old) == 1
    path = tmp_path / "mine.yaml"
    path.write_text(text.replace(old, new))
    with pytest.raises(UserError) as caught:
        read_protocol(path)
    assert sentence in str(caught.value) and str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value) and len(str(caught.value)) < len(str(path)) + 300


def test_files_that_are_no_protocols(tmp_path: Path) -> None:
    contents = {"list.yaml": "- a", "empty.yaml": "", "huge.yaml": "a: " + "b" * 70000, "binary.yaml": "\x00\x01"}
    for name, content in contents.items():
        (tmp_path / name).write_text(content)
        with pytest.raises(UserError, match=name):
            read_protocol(tmp_path / name)
    (tmp_path / "latin.yaml").write_bytes(b"summary: \xff")
    with pytest.raises(UserError, match=r"latin\.yaml is not UTF-8 text"):
        read_protocol(tmp_path / "latin.yaml")
    with pytest.raises(UserError, match=r"none\.yaml does not exist"):
        choose_protocols([str(tmp_path / "none.yaml")])
    odd = tmp_path / "my protocol.yaml"
    odd.write_text(builtin_protocols()["strict"].read_text())
    with pytest.raises(UserError, match="use letters, digits"):
        read_protocol(odd)


@pytest.mark.parametrize(
    ("written", "colour"), [("blue", (0, 0, 1)), ('"#00ff00"', (0, 1, 0)), ("[1, 0, 0]", (1, 0, 0))]
)
def test_a_background_is_written_as_everywhere_else(written: str, colour: tuple[float, ...], tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(builtin_protocols()["strict"].read_text().replace("background: white", f"background: {written}"))
    assert read_protocol(path).background == colour


def test_every_choice_can_be_made(tmp_path: Path) -> None:
    path = tmp_path / "other.yaml"
    path.write_text(
        "summary: s\nsource: t\nframes: 12\nbackground: [0, 0.5, 1]\nmask: only\nclamp: false\nlevels: float\n"
        "regions: [rest, head]\nlpips_net: alex\nlpips_scale: 0.05\n"
    )
    protocol = read_protocol(path)
    assert (
        protocol.name == "other"
        and protocol.frames == 12
        and protocol.image_format == ((0.0, 0.5, 1.0), False, "float")
    )
    assert protocol.mask == "only" and protocol.lpips_net == "alex" and protocol.lpips_scale == 0.05
    assert protocol.columns == (
        *("psnr", "ssim", "lpips"),
        *("psnr_head", "ssim_head", "lpips_head"),
        *("psnr_rest", "ssim_rest", "lpips_rest"),
        "jitter",
    )
