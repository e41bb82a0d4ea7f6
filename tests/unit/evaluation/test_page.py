import json
import re
from html.parser import HTMLParser

import pytest

from slotfilm_dist.evaluation.page import write_page
from slotfilm_dist.evaluation.record import read_run


class Page(HTMLParser):
    """Collects what a browser would load, show and link, and checks that tags are closed in order."""

    VOID = frozenset({"meta", "img", "br"})

    def __init__(self, text):
        super().__init__()
        self.sources, self.alts, self.ids, self.links, self.open, self.words = [], [], [], [], [], []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.sources += [values[k] for k in ("src", "poster") if k in values]
        self.links += [values["href"]] if "href" in values else []
        self.ids += [values["id"]] if "id" in values else []
        if tag == "img":
            self.alts.append(values.get("alt") or "")
        if tag == "video":
            self.alts.append(values.get("aria-label") or "")
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, text):
        self.words.append(text)

    @property
    def text(self):
        return " ".join("".join(f"{word} " for word in self.words).split())


@pytest.fixture(scope="module")
def finished(tmp_path_factory, write_run):
    run_dir = write_run(tmp_path_factory.mktemp("runs") / "finished", finished=True)
    return run_dir, Page(write_page(run_dir).read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def unfinished(tmp_path_factory, write_run):
    run_dir = write_run(tmp_path_factory.mktemp("runs") / "unfinished", finished=False)
    return run_dir, Page(write_page(run_dir).read_text(encoding="utf-8"))


def test_page_is_closed_html_and_loads_nothing_from_elsewhere(finished):
    run_dir, page = finished
    assert page.open == []
    assert len(page.sources) == 8
    assert all(source.startswith(("data:image/png;base64,", "data:video/mp4;base64,")) for source in page.sources)
    text = (run_dir / "report.html").read_text(encoding="utf-8")
    assert not re.search(r"https?://|@import|<script|<link|url\(", text)


def test_every_picture_and_video_has_a_text(finished):
    _, page = finished
    assert len(page.alts) == 8
    assert all(len(alt) > 20 for alt in page.alts)


def test_links_lead_to_sections(finished):
    _, page = finished
    assert len(page.links) == 5
    assert {link.removeprefix("#") for link in page.links} == set(page.ids)


def test_headline_names_the_run_and_compares_with_random_on_the_same_seeds(finished):
    run_dir, page = finished
    record = read_run(run_dir)
    final, random = record.evaluation("final"), record.evaluation("random")
    low, high = final.success_interval
    assert "slotfilm on PickBanana-v1, seed 3" in page.text
    assert "The final policy beats the random policy on the same 50 seeds" in page.text
    assert f"random policy: {random.mean_return:.1f}" in page.text
    assert f"95 % Wilson interval [{100 * low:.1f}, {100 * high:.1f}] %" in page.text
    assert "predicting the mean position: 27.5 px" in page.text
    assert "evaluate: done" in page.text


def test_differences_from_the_defaults_are_listed_and_nothing_else(finished):
    _, page = finished
    table = page.text.split("Fields that differ from the defaults.")[1].split("Full configuration")[0]
    assert re.findall(r"[a-z_]+\.[a-z_]+", table) == [
        *("sac.temperature", "sac.critic_norm", "schedule.total_steps", "schedule.random_steps")
    ]
    assert '"reward_scale": 10.0' in page.text


def test_command_and_versions_are_shown(finished):
    _, page = finished
    assert "slotfilm train laptop --seed 3" in page.text
    assert "torch 2.9.1" in page.text


def test_finished_run_misses_nothing(finished):
    _, page = finished
    assert "Not in this report" not in page.text


def test_figures_are_files_of_the_run_too(finished):
    run_dir, _ = finished
    names = {path.stem for path in (run_dir / "figures").iterdir()}
    assert names == {"return", "success", "pretraining", "reward_terms", "learner", "throughput"}


def test_unfinished_run_gives_a_page_that_names_what_is_missing(unfinished):
    _, page = unfinished
    missing = page.text.split("Not in this report")[2].split("Return of every training episode")[0]
    assert "no final evaluation yet" in missing
    assert "the random policy was not evaluated" in missing
    assert "no rollout was recorded" in missing
    assert "The policy after 50 000 steps was evaluated" in page.text
    assert "train: now" in page.text
    assert "of 160 000 planned (38 %)" in page.text


def test_empty_run_directory_gives_a_page_of_gaps(tmp_path):
    page = Page(write_page(tmp_path).read_text(encoding="utf-8"))
    for name in ("config.json", "versions.json", "metrics.jsonl", "episodes.jsonl", "evaluation/final.json"):
        assert name in page.text
    assert "Figure “Return”" in page.text
    assert page.sources == []
    assert page.open == []


def test_directory_that_does_not_exist_is_refused(tmp_path):
    with pytest.raises(ValueError, match="is no directory"):
        write_page(tmp_path / "nowhere")


def test_torn_lines_and_damaged_files_are_named_and_the_rest_is_shown(tmp_path, write_run):
    run_dir = write_run(tmp_path / "run", finished=False)
    with (run_dir / "metrics.jsonl").open("ab") as file:
        file.write(b'{"time_s": 1, "env_st')
    (run_dir / "evaluation" / "final.json").write_text('{"name": "final"}')
    (run_dir / "versions.json").write_text("{")
    page = Page(write_page(run_dir).read_text(encoding="utf-8"))
    assert "metrics.jsonl: 1 unreadable line(s)" in page.text
    assert "evaluation/final.json: incomplete" in page.text
    assert "versions.json is not valid JSON" in page.text
    assert len(page.sources) == 6


def test_texts_of_the_run_cannot_inject_markup(tmp_path, write_run):
    run_dir = write_run(tmp_path / "run", finished=False)
    attack = "<script>alert(1)</script>\"'&"
    (run_dir / "versions.json").write_text(json.dumps({"command": attack, attack: attack, "started_at": attack}))
    text = write_page(run_dir).read_text(encoding="utf-8")
    assert "<script" not in text
    assert text.count("&lt;script&gt;alert(1)") == 5


def test_video_too_large_for_the_page_is_left_out_and_named(tmp_path):
    (tmp_path / "videos").mkdir()
    (tmp_path / "videos" / "long.mp4").write_bytes(bytes(3_100_000))
    page = Page(write_page(tmp_path).read_text(encoding="utf-8"))
    assert "videos/long.mp4: 3.1 MB is too large" in page.text
    assert page.sources == []
