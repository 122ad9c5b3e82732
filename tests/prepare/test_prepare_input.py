"""What mmpi-prepare takes in: images, masks, videos, cameras, pairs; and what it says to bad input."""

from __future__ import annotations

import corridor
import cv2
import numpy as np
import pycolmap
import pytest
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from mmpi_ns.utils.errors import InputError
from mmpi_prepare import checks, export, features
from mmpi_prepare.images import (
    Photo,
    find_images,
    gather,
    measure,
    select_frames,
    sharpness,
)
from mmpi_prepare.pipeline import prepare
from mmpi_prepare.poses import make_cameras
from mmpi_prepare.settings import Settings
from mmpi_priors.maker import light_of


def save(path, size=(40, 30), value=100, **more):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size, (value, value, value)).save(path, **more)
    return path


def test_images_come_in_natural_order(tmp_path):
    names = ["f1.jpg", "f1²2.jpg", "f9.jpg", "f10.jpg"]
    for name in names:
        save(tmp_path / name)
    assert [p.name for p in find_images(tmp_path)] == names


def test_names_of_subfolders_stay_apart(tmp_path):
    files = [save(tmp_path / f) for f in ("left/a 1.jpg", "right/a 1.jpg", "right/a 1.png", "#1.jpg")]
    names = [photo.name for photo in gather(tmp_path, files, tmp_path / "out")]
    assert names == ["left-a_1.jpg", "right-a_1.jpg", "right-a_1_.png", "_1.jpg"]


def test_turned_photo_is_set_upright_and_its_focal_length_read(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    exif.get_ifd(0x8769)[0xA405] = 36
    for n in range(2):
        save(tmp_path / "in" / f"{n}.jpg", exif=exif)
    photos = gather(tmp_path / "in", find_images(tmp_path / "in"), tmp_path / "out")
    assert (photos[0].width, photos[0].height) == (30, 40)
    assert Image.open(tmp_path / "out/images/0.jpg").size == (30, 40)
    assert photos[0].exif_focal == pytest.approx(40)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".heic"])
def test_every_written_image_keeps_its_exposure(suffix, turned, tmp_path):
    """Copied, set upright, converted, and downscaled."""
    if suffix == ".heic":
        pytest.importorskip("pillow_heif").register_heif_opener()
    for n in range(2):
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation] = 6 if turned else 1
        exif[ExifTags.Base.Model] = "Phone"
        shot = {ExifTags.Base.ExposureTime: IFDRational(1, 250 + n), ExifTags.Base.ISOSpeedRatings: 80}
        shot |= {ExifTags.Base.FNumber: IFDRational(9, 5), ExifTags.Base.MakerNote: b"x" * 9000}
        exif.get_ifd(ExifTags.IFD.Exif).update(shot)
        (tmp_path / "in").mkdir(exist_ok=True)
        with Image.open(save(tmp_path / "phone.jpg", (64, 48), exif=exif)) as image:
            image.save(tmp_path / f"in/{n}{suffix}", exif=image.getexif())  # Pillow writes a new Exif to no TIFF
    photos = gather(tmp_path / "in", find_images(tmp_path / "in"), tmp_path / "out")
    export.write_images(tmp_path / "out/images", None, photos, tmp_path / "scene", (2,))
    for folder in ("images", "images_2"):
        files = [tmp_path / "scene" / folder / photo.name for photo in photos]
        for n, file in enumerate(files):
            assert light_of(file) == pytest.approx(80 / (250 + n) / 1.8**2)
            with Image.open(file) as image:
                assert image.getexif().get(ExifTags.Base.Orientation, 1) == 1
                assert image.getexif()[ExifTags.Base.Model] == "Phone"


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp"])
def test_damaged_exif_counts_as_none(suffix, tmp_path):
    file = save(tmp_path / f"in/a{suffix}", exif=b"Exif\0\0no tags at all")
    (photo,) = gather(file.parent, [file], tmp_path / "work")
    assert photo.exif_focal is None and photo.width == 40 and np.isnan(light_of(file))


def test_plain_photo_is_copied_byte_for_byte(tmp_path):
    files = [save(tmp_path / "in" / f"{n}.jpg", value=n) for n in range(2)]
    gather(tmp_path / "in", files, tmp_path / "out")
    assert (tmp_path / "out/images/1.jpg").read_bytes() == files[1].read_bytes()


def test_masked_pixels_stay_masked_when_downscaled(tmp_path):
    mask = np.full((4, 4), 255, np.uint8)
    mask[1, 1] = 0
    Image.fromarray(mask).save(tmp_path / "m.png")
    export.downscale(tmp_path / "m.png", tmp_path / "small.png", 2, mask=True)
    assert np.asarray(Image.open(tmp_path / "small.png")).tolist() == [[0, 255], [255, 255]]


def test_focal_length_comes_from_the_option_then_exif_then_a_guess():
    photos = [Photo("a", 100, 50, exif_focal=77.0)]
    bare = [Photo("a", 100, 50)]
    for images, focal, expected in ((photos, 60.0, 60), (photos, None, 77), (bare, None, 120)):
        (camera,) = make_cameras(images, "auto", {}, focal, "auto")[1]
        assert camera.mean_focal_length() == expected


def chain(count):
    """Similarity that falls off along a sequence."""
    place = np.arange(count, dtype=float)
    alike = np.exp(-((place[:, None] - place[None]) ** 2) / 50)
    np.fill_diagonal(alike, -1)
    return alike.astype(np.float32)


def test_matching_is_chosen_by_count_and_order():
    numbered = [f"f{i:03d}.jpg" for i in range(200)]
    shuffled = np.random.default_rng(0).permutation(200)
    mixed = chain(200)[np.ix_(shuffled, shuffled)]
    for names, alike, from_video, way in (
        (numbered[:20], chain(20), False, "exhaustive (20 images are few)"),
        (numbered, chain(200), False, "sequential (numbered frames that look like their neighbours), 0 pairs"),
        (numbered, mixed, False, "retrieval (200 images in no order are too many to match all)"),
        (numbered[:100], mixed[:100, :100], False, "exhaustive (100 images in no order)"),
        (numbered, mixed, True, "sequential (frames of a video), "),
    ):
        assert features.choose_pairs("auto", names, alike, 10, from_video)[1].startswith(way)


def test_look_alikes_are_found_by_their_features(tmp_path):
    for seed in (1, 2):
        corridor.write_images(tmp_path / "in" / str(seed), 2, seed=seed)
    photos = gather(tmp_path / "in", find_images(tmp_path / "in"), tmp_path)
    database = tmp_path / "database.db"
    cameras = make_cameras(photos, "shared", {}, None, "auto")
    features.extract(tmp_path / "images", photos, cameras, None, 1000, 1, tmp_path)
    alike = features.image_similarity(database, 4)
    assert alike.argmax(-1).tolist() == [1, 0, 3, 2]


def test_split_by_count_and_by_list():
    names = [f"{i}.jpg" for i in range(9)]
    split = export.split_images(names, 3)
    assert split.test == ("1.jpg", "4.jpg", "7.jpg") and len(split.train) == 6
    lists = {"train_filenames": ["x/2.jpg"], "test_filenames": ["x/3.jpg", "x/99.jpg"]}
    assert export.split_images(names, lists=lists, source="s").test == ("3.jpg",)
    with pytest.raises(InputError, match="among the registered"):
        export.split_images(names, lists={"train_filenames": ["2.jpg"], "test_filenames": ["77.jpg"]}, source="s")


def write_video(path, frames):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (corridor.WIDTH, corridor.HEIGHT))
    for frame in frames:
        writer.write(frame[..., ::-1].copy())
    writer.release()
    return path


@pytest.fixture(scope="module")
def drive():
    """Frames that stand still, drive, and stand again; two of the drive are blurred."""
    moving = [corridor.picture(p) for p in corridor.poses(16, step=0.25)]
    for i in (6, 9):
        moving[i] = cv2.GaussianBlur(moving[i], (0, 0), 3)
    return [moving[0]] * 6 + moving + [moving[-1]] * 6


def test_frames_are_chosen_by_motion_and_sharpness(drive, tmp_path):
    video = write_video(tmp_path / "drive.avi", drive)
    photos = select_frames(video, tmp_path / "out", 300, 0.03)
    chosen = [int(p.name[6:12]) for p in photos]
    assert 5 <= len(chosen) <= 14
    assert sum(c < 6 for c in chosen) <= 1 and sum(c > 22 for c in chosen) <= 1  # standing gives no more frames
    assert not {12, 15} & set(chosen)
    size = Image.open(tmp_path / "out/images" / photos[0].name).size
    assert size == (corridor.WIDTH, corridor.HEIGHT) == (photos[0].width, photos[0].height)


def test_broken_video_is_named(tmp_path, drive):
    (tmp_path / "no.mp4").write_bytes(b"not a video at all" * 100)
    with pytest.raises(InputError, match=r"no\.mp4"):
        measure(tmp_path / "no.mp4")
    still = write_video(tmp_path / "still.avi", [drive[0]] * 5)
    with pytest.raises(InputError, match="no motion"):
        select_frames(still, tmp_path / "out2", 300, 0.02)


@pytest.mark.parametrize(("count", "words"), [(0, "no image"), (1, "one image only")])
def test_too_few_images_are_refused(count, words, tmp_path):
    (tmp_path / "in").mkdir()
    for n in range(count):
        save(tmp_path / "in" / f"{n}.png")
    with pytest.raises(InputError, match=words):
        prepare(Settings(tmp_path / "in", tmp_path / "scene"))


def test_truncated_image_is_named(tmp_path):
    save(tmp_path / "in/a.png")
    (tmp_path / "in/b.jpg").write_bytes(save(tmp_path / "whole.jpg", (90, 90)).read_bytes()[:300])
    with pytest.raises(InputError, match=r"b\.jpg cannot be read"):
        prepare(Settings(tmp_path / "in", tmp_path / "scene"))


def test_images_without_overlap_are_refused(tmp_path):
    (tmp_path / "in").mkdir()
    for n in range(3):
        Image.fromarray(corridor.picture(corridor.poses(1)[0], seed=n)).save(tmp_path / "in" / f"{n}.png")
    with pytest.raises(InputError, match="overlap"):
        prepare(Settings(tmp_path / "in", tmp_path / "scene", threads=1))


def test_two_disconnected_groups_are_named_and_the_larger_can_be_had(tmp_path, capsys):
    corridor.write_images(tmp_path / "in", 7, seed=1)
    corridor.write_images(tmp_path / "in", 6, seed=2, start=20)
    settings = Settings(tmp_path / "in", tmp_path / "scene", threads=1)
    prepare(settings)
    report = (tmp_path / "scene/report.md").read_text()
    assert "7 of 13" in report and "6 images form a group of their own" in report and "frame_021.png" in report
    assert "6 images form a group of their own" in " ".join(capsys.readouterr().out.split())


def test_scene_and_input_are_kept_apart(tmp_path):
    corridor.write_images(tmp_path / "scene/images", 2)
    for scene in (tmp_path / "scene", tmp_path / "scene/images", tmp_path / "scene/images/out"):
        with pytest.raises(InputError, match="mixed with its input"):
            prepare(Settings(tmp_path / "scene/images", scene, overwrite=True))
    assert len(list((tmp_path / "scene/images").iterdir())) == 2


def test_overwriting_moves_the_old_scene_aside(tmp_path):
    built, scene = tmp_path / "built", tmp_path / "scene"
    for folder, text in ((built, "new"), (scene, "old")):
        (folder / "images").mkdir(parents=True)
        (folder / "images/a.txt").write_text(text)
        (folder / "transforms.json").write_text(text)
    export.publish(built, scene, scene / "previous-1")
    assert (scene / "images/a.txt").read_text() == (scene / "transforms.json").read_text() == "new"
    assert (scene / "previous-1/images/a.txt").read_text() == "old"


def test_jump_and_turn_of_the_track_are_found():
    poses = corridor.poses(20)
    names = [f"f{i:02d}" for i in range(20)]
    assert checks.misplaced(names, range(20), poses) == []
    off = poses.copy()
    off[9, :3, 3] += [0, 6, 0]
    assert {f.image for f in checks.misplaced(names, range(20), off)} == {"f09", "f10"}
    turned = poses.copy()
    turned[9, :3, :3] = turned[9, :3, :3] @ np.diag([-1.0, 1, -1])
    assert {f.image for f in checks.misplaced(names, range(20), turned)} == {"f09", "f10"}


def test_a_blurred_frame_is_found_and_the_plain_end_of_a_pan_is_not_called_blurred():
    images = [cv2.cvtColor(corridor.picture(p), cv2.COLOR_RGB2GRAY) for p in corridor.poses(9)]
    images[4] = cv2.GaussianBlur(images[4], (0, 0), 2)
    images[8] = cv2.GaussianBlur(images[8], (0, 0), 4)
    sharp = np.array([sharpness(i) for i in images])
    assert [f.image for f in checks.blurred(list("abcdefghi"), sharp)] == ["e"]
    dark = np.array([1.0] * 6 + [0.2] * 6)
    assert checks.blurred(list("abcdefghijkl"), dark) == [], "a walk into a dark room"


def test_numbers_in_names_are_an_order_only_where_the_matches_support_it(tmp_path):
    names = [f"{i:02d}.png" for i in range(25)]
    shuffled = np.random.default_rng(0).permutation(25)
    in_parts = np.arange(25).reshape(-1, 5)[[2, 0, 4, 1, 3]][:, [1, 3, 0, 4, 2]].ravel()
    for order, is_ordered in ((np.arange(25), True), (shuffled, False), (in_parts, False)):
        database = tmp_path / f"{order[0]}-{is_ordered}.db"
        with pycolmap.Database.open(database) as opened:
            camera = opened.write_camera(pycolmap.Camera(model="SIMPLE_PINHOLE", width=4, height=4, params=[4, 2, 2]))
            for name in names:
                opened.write_image(pycolmap.Image(name=name, camera_id=camera))
            for i in range(25):
                for j in range(i):
                    geometry, matches = pycolmap.TwoViewGeometry(), 200 - 7 * abs(int(order[i]) - int(order[j]))
                    geometry.inlier_matches = np.tile(np.arange(max(matches, 1))[:, None], 2).astype(np.uint32)
                    opened.write_two_view_geometry(j + 1, i + 1, geometry)
        assert features.are_in_order(database, names) == is_ordered
        assert not features.are_in_order(database, [f"{n}_{25 - i}" for i, n in enumerate("abcdefghijklmnopqrstuvwxy")])
