import pytest
from support.refused import refusing
from support.sweeps import jobs_of

from pp_studio.sweep.plan import read_varied


@pytest.fixture
def scenes(tmp_path):
    folders = [tmp_path / "scenes" / name for name in "ab"]
    for folder in folders:
        folder.mkdir(parents=True)
    return folders


def test_every_combination_is_a_run_of_its_own(tmp_path, scenes):
    varied = read_varied(["points.count=1000,2000", "network.widths=16,16,16/32,32,32"])
    assert varied == {"points.count": ["1000", "2000"], "network.widths": ["16,16,16", "32,32,32"]}
    jobs = jobs_of(scenes, tmp_path / "out", [1, 5], varied, given=[])
    assert len(jobs) == len({job.folder for job in jobs}) == 2 * 2 * 2 * 2
    slugs = [
        f"points.count={count}_network.widths={width},{width},{width}"
        for count in (1000, 2000)
        for width in (16, 32)
    ]
    expected = [(s, slug, seed) for s in "ab" for slug in slugs for seed in (1, 5)]
    out = tmp_path / "out"
    assert [job.folder for job in jobs] == [
        str(out / scene / slug / f"seed-{seed}") for scene, slug, seed in expected
    ]
    job = jobs[2]
    assert job.varied == {"points.count": "1000", "network.widths": "32,32,32"}
    assert [setting[:2] for setting in job.given] == [
        ("points.count", "1000"),
        ("network.widths", "32,32,32"),
        ("train.seed", "1"),
    ]


@pytest.mark.parametrize(
    "texts, words",
    [
        (["points.count="], ["--vary", "section.key=value"]),
        (["points.none=1"], ["--vary", "unknown key", "points.none"]),
        (["points.count=1,x"], ["--vary", "points.count", "'x'", "whole number"]),
        (["points.count=5,0"], ["points.count = 0"]),
        (["points.count=1000,1000"], ["two runs", "points.count=1000"]),
        (["points.count=1", "points.count=2"], ["--vary", "varied already"]),
        (["train.seed=1,2"], ["--vary train.seed", "--seeds"]),
        (["scene.path=a,b"], ["--vary", "scene.path"]),
    ],
)
def test_what_cannot_be_varied(tmp_path, texts, words):
    with refusing(*words):
        jobs_of(["demo"], tmp_path, varied=read_varied(texts), given=[])


@pytest.mark.parametrize("key", ["train.seed", "scene.path", "points.count"])
def test_what_tells_runs_apart_cannot_be_set(tmp_path, key):
    given, varied = [(key, "1", "--set")], {"points.count": ["5"]}
    with refusing("--set", key):
        jobs_of(["demo"], tmp_path, varied=varied, given=given)


def test_scenes_that_cannot_be_told_apart(tmp_path, scenes):
    for name in ("a", "A", "demo"):
        (tmp_path / "other" / name).mkdir(parents=True)
    for other in (tmp_path / "other" / "a", tmp_path / "other" / "A", f"{scenes[0]}/../a"):
        with refusing("two runs", "scenes"):
            jobs_of([scenes[0], other], tmp_path)
    with refusing("two runs"):
        jobs_of(["demo", tmp_path / "other" / "demo"], tmp_path)
