import pytest
from support.sweeps import jobs_of, pretend

from pp_cl.files.run_folder import RunFolder
from pp_studio.sweep.table import finished_row


@pytest.fixture
def job(tmp_path):
    return jobs_of(["demo"], tmp_path / "out", [4])[0]


def test_a_run_that_is_trained_and_measured(job):
    pretend(job, 21.5, 0.75, points=7, seconds=12.5)
    assert finished_row(job) == {
        "scene": "demo",
        "settings": {},
        "seed": 4,
        "folder": job.folder,
        "psnr": 21.5,
        "ssim": 0.75,
        "points": 7,
        "device": "a device",
        "seconds": 12.5,
    }


@pytest.mark.parametrize("what", [{"finished": False}, {"step": 3}])
def test_what_is_not_trained_and_measured_to_its_end_has_no_row(job, what):
    assert finished_row(job) is None
    pretend(job, 21.5, **what)
    assert finished_row(job) is None


def test_a_measurement_that_is_not_whole_is_made_again(job):
    pretend(job, 21.5)
    file = RunFolder(job.folder).metrics("test")
    whole = file.read_text()
    for text in (
        whole.replace("21.5", "NaN"),
        whole.replace("21.5", "9" * 400),
        whole.replace('"finished": true', '"finished": false'),
        whole.replace('"a device"', "2"),
        whole.replace('"ssim"', '"other"'),
        "[]",
        "[" * 100_000,
    ):
        assert text != whole
        file.write_text(text)
        assert finished_row(job) is None
    file.write_text(whole)
    assert finished_row(job)["psnr"] == 21.5
