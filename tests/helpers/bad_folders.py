"""Damaged folders, each with the sentence that it gets."""

from __future__ import annotations

import shutil

import cv2
import numpy as np
import torch
from folder_damage import (
    Edit,
    all_zero,
    copy_of_previous,
    cut,
    edit_frame,
    every,
    freeze,
    hostile,
    masks_of_three_labels,
    matching,
    move_centre,
    nan_in,
    remove,
    renumbered,
    resize,
    set_K,
    shift_masks,
    swap_frames,
    write,
)

TWO = (5, 6)
EMPTY_MASK = cv2.imencode(".png", np.zeros((64, 64), np.uint8))[1].tobytes()
CASES: dict[str, tuple[Edit, str]] = {
    # what is there and how it is numbered
    "folder missing": (shutil.rmtree, r"the folder .*subject does not exist"),
    "folder is a file": (
        lambda f: (shutil.rmtree(f), f.write_text("")),
        r"subject is a file; give the folder that holds",
    ),
    "no imgs": (lambda f: shutil.rmtree(f / "imgs"), r"has no frames: put them in .*imgs as 00001\.jpg"),
    "imgs empty": (remove("imgs/*"), r"has no frames: put them in .*imgs as 00001\.jpg"),
    "image without number": (
        lambda f: shutil.copy(f / "imgs/00001.jpg", f / "imgs/cover.jpg"),
        r"imgs/cover\.jpg has no frame number at the end of its name; rename or remove it",
    ),
    "number twice": (
        lambda f: shutil.copy(f / "imgs/00001.jpg", f / "imgs/1.jpg"),
        r"imgs/00001\.jpg and .*imgs/1\.jpg are both frame 1; remove one of them",
    ),
    "number twice, two formats": (
        lambda f: cv2.imwrite(str(f / "imgs/00002.png"), np.zeros((64, 64, 3), np.uint8)),
        r"00002\.jpg and .*00002\.png are both frame 2",
    ),
    "mattes numbered anew": (
        every(lambda n: renumbered("alpha", n), range(1, 25)),
        r"alpha has the numbers 00000 to 00023 and imgs 00001 to 00024, but a mask has the number of its image; rename",
    ),
    "all masks numbered anew": (
        every(lambda n: lambda f: [renumbered(kind, n)(f) for kind in ("alpha", "parsing")], range(1, 25)),
        r"alpha has the numbers 00000 to 00023 and imgs 00001 to 00024, but a mask has the number of its image; rename",
    ),
    "no checkpoint": (
        lambda f: shutil.rmtree(f / "checkpoint"),
        r"checkpoint holds no \.frame files of metrical-tracker; give --tracking",
    ),
    "half of the tracking": (
        remove("checkpoint/0001*.frame"),
        r"10 of 24 images have no partner under offset 1: images are 24 files numbered 00001 to 00024, "
        r"tracking is 14 files numbered 00000 to 00023",
    ),
    "half of the images": (remove("imgs/0001*.jpg"), r"10 of 24 tracking frames have no partner under offset 1"),
    "half of the head masks": (
        remove("parsing/0001*_neckhead.png"),
        r"10 of 24 images cannot be used, more than 5%: 00010-00019 \(it has no head mask\)",
    ),
    "two files swapped": (swap_frames, r"00003\.frame says inside that it is frame 7, while 00000\.frame says 0"),
    # images
    "images cut short": (
        cut("imgs/0000[56].jpg"),
        r"2 of 24 images cannot be used, .*00005\.jpg is cut short; write or",
    ),
    "images empty": (write("imgs/0000[56].jpg", b""), r"imgs/00005\.jpg is empty; write or copy it again"),
    "images are text": (
        write("imgs/0000[56].jpg", b"<html>404</html>"),
        r"imgs/00005\.jpg is neither a JPEG nor a PNG file, whatever its name says",
    ),
    "images damaged": (
        write("imgs/0000[56].jpg", b"\xff\xd8\xff" + b"x" * 80 + b"\xff\xd9"),
        r"imgs/00005\.jpg is damaged and cannot be decoded",
    ),
    "all images damaged": (
        cut("imgs/*.jpg"),
        r"none of the 24 images in .*imgs can be read: .*00001\.jpg is cut short",
    ),
    "PNG cut short": (cut("parsing/0000[56]_neckhead.png"), r"00005_neckhead\.png is cut short"),
    "an image of another size": (
        resize("imgs/00009.jpg", (48, 64)),
        r"imgs/00009\.jpg is 48x64 pixels but 00001\.jpg is 64x64; all frames must have one size",
    ),
    "a mask of another size": (
        resize("parsing/00009_mouth.png", (32, 32)),
        r"00009_mouth\.png is 32x32 pixels but the images are 64x64",
    ),
    "alpha of another size": (
        resize("alpha/*.jpg", (128, 128)),
        r"alpha/00001\.jpg is 128x128 pixels but the images are",
    ),
    "masks of three labels": (
        masks_of_three_labels,
        r"the head masks in .*parsing reach only 2 of 255 \(values 0, 1, 2\).*; make the person 255",
    ),
    "head masks empty": (
        write("parsing/0000[56]_neckhead.png", EMPTY_MASK),
        r"00005 \(00005_neckhead\.png is empty: no head was found\)",
    ),
    # tracking
    "tracking hostile": (hostile, r"00004\.frame was not read: it refers to os\.system, which is code"),
    "tracking cut short": (
        cut("checkpoint/0000[56].frame"),
        r"2 of 24 tracking files cannot be used, more than 5%: 00005-00006 \(is damaged or cut short",
    ),
    "tracking empty": (write("checkpoint/0000[56].frame", b""), r"00005-00006 \(is empty; write or copy it again\)"),
    "tracking is text": (
        write("checkpoint/0000[56].frame", b"hello"),
        r"00005-00006 \(is damaged, cut short or not a pick",
    ),
    "tracking is a list": (
        lambda f: [torch.save([1], p) for p in matching(f, "checkpoint/0000[56].frame")],
        r"00005-00006 \(no 'flame' in it: not a file of metrical-tracker\)",
    ),
    "no face": (every(all_zero, (5, 6, 9)), r"3 of 24 .*: 00005-00006, 00009 \(all zero: the tracker found no face\)"),
    "no face anywhere": (every(all_zero), r"24 of 24 tracking files .*all zero: the tracker found no face"),
    "not finite": (
        every(lambda n: edit_frame(n, flame__exp=nan_in), TWO),
        r"00005-00006 \(flame\.exp is not finite \(1 of 10 values\)\)",
    ),
    "translation infinite": (
        every(lambda n: edit_frame(n, opencv__t=lambda t: t * np.inf), TWO),
        r"opencv\.t is not finite",
    ),
    "a section missing": (
        every(lambda n: edit_frame(n, opencv=None), TWO),
        r"no 'opencv' in it: not a file of metrical",
    ),
    "a key missing": (every(lambda n: edit_frame(n, flame__jaw=None), TWO), r"00005-00006 \(flame\.jaw is missing\)"),
    "a value is text": (every(lambda n: edit_frame(n, flame__jaw="open"), TWO), r"flame\.jaw is not numbers"),
    "a value too long": (
        every(lambda n: edit_frame(n, flame__jaw=np.zeros(7)), TWO),
        r"flame\.jaw has 7 values, not 6",
    ),
    "eyes degenerate": (
        every(lambda n: edit_frame(n, flame__eyes=np.ones(12)), TWO),
        r"flame\.jaw or flame\.eyes is not a rotation \(its two rows are zero or parallel\)",
    ),
    "R scaled": (
        every(lambda n: edit_frame(n, opencv__R=lambda R: 2 * R), TWO),
        r"R is not a rotation \(determinant 8",
    ),
    "R a reflection": (
        every(lambda n: edit_frame(n, opencv__R=lambda R: -R), TWO),
        r"R is not a rotation \(determinant -1",
    ),
    "K without focal length": (
        every(lambda n: edit_frame(n, opencv__K=np.eye(3)[None] * 0), TWO),
        r"opencv\.K is not of the form",
    ),
    "K changes": (
        edit_frame(9, opencv__K=set_K(1.2)),
        r"intrinsics change within the clip: fx fy cx cy = 179\.20 .* with 00000\.frame and .* with 00009\.frame",
    ),
    "a picture that is cut elsewhere": (
        edit_frame(9, opencv__K=move_centre(1.0)),
        r"intrinsics change within .* 32\.00 32\.00 with 00000\.frame and .* 33\.00 33\.00 with 00009\.frame; ",
    ),
    "image size missing": (every(lambda n: edit_frame(n, img_size=None), TWO), r"img_size is not \(width, height\)"),
    "image sizes mixed": (
        edit_frame(9, img_size=np.array([512, 512])),
        r"00009\.frame was tracked on 512x512 images but 00000\.frame on 64x64",
    ),
    "tracked at another size": (
        every(lambda n: edit_frame(n, img_size=np.array([512, 512]))),
        r"the tracking was made on 512x512 images, but those in .*imgs are 64x64; resize the images",
    ),
    "expressions differ": (
        every(lambda n: edit_frame(n, flame__exp=np.ones((1, 9))), TWO),
        r"9 expression coefficients where 00000\.frame has 10",
    ),
    "head model with fewer expressions": (
        every(lambda n: edit_frame(n, flame__exp=np.ones((1, 50)))),
        r"the tracking has 50 expression coefficients but the head model has 10 expression",
    ),
    "identity too long": (
        every(lambda n: edit_frame(n, flame__shape=np.ones((1, 400)))),
        r"the tracking has 400 identity coefficients but the head model has 300 identity directions",
    ),
    "repeated": (
        every(copy_of_previous, (5, 6, 9)),
        r"00006-00007, 00010 \(the tracking repeats that of the frame before, while the image does not\)",
    ),
    "behind the camera": (
        every(lambda n: edit_frame(n, opencv__t=lambda t: -t), TWO),
        r"the tracked head is behind the camera",
    ),
    # offset
    "no masks, and images that do not move": (
        lambda f: (
            shutil.rmtree(f / "parsing"),
            shutil.rmtree(f / "alpha"),
            [shutil.copy(f / "imgs/00001.jpg", p) for p in matching(f, "imgs/*")[1:]],
        ),
        r"the offset between images and tracking is not clear .*and give --frame-offset \(1 where images",
    ),
    "nothing moves": (
        freeze,
        r"the offset between images and tracking is not clear \(best is .*and give --frame-offset",
    ),
    "masks elsewhere": (
        shift_masks,
        r"neither the tracked head .* nor its lips .*is the head model the one .* this video",
    ),
    "far too few frames": (
        lambda f: [remove(f"{d}/{n}.*")(f) for d in ("imgs", "checkpoint") for n in ("000[12]*", "0000[5-9]")],
        r"there are too few frames to find the offset between images and tracking \(4 images, 5 tracking frames; 7 of each "
        r"are needed\); give --frame-offset \(1 where",
    ),
}
