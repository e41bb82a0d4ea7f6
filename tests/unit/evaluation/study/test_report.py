import csv
import dataclasses
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from slotfilm_dist.commands.report import main
from slotfilm_dist.evaluation.study.collection import collect_study
from slotfilm_dist.evaluation.study.paper import ITEMS
from slotfilm_dist.evaluation.study.report import write_study

SHOWN = {"Figure 3", "Figure 4", "Figure 7", "Figure 9", "Figure 11", "Table 1", "Table 2", "Table 3"}
SHOWN |= {"Table A1", "Table A2", "Table A3", "Table A4"}


class Page(HTMLParser):
    """Headings, pictures and links of a page; checks that tags are closed in order."""

    def __init__(self, text):
        super().__init__()
        self.headings, self.sources, self.alts, self.ids, self.links, self.open = [], [], [], [], [], []
        self.header_cells = 0
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.ids += [values["id"]] if "id" in values else []
        self.links += [values["href"]] if "href" in values else []
        self.header_cells += tag == "th" and "scope" in values
        if tag == "img":
            self.sources.append(values["src"])
            self.alts.append(values["alt"])
        if tag not in ("meta", "img"):
            self.open.append(tag)
        if tag == "h2":
            self.headings.append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, text):
        if self.open and self.open[-1] == "h2":
            self.headings[-1] += text


def measure(path):
    """What evaluate, probe and robustness leave in a run, for one of their kinds of latents."""
    folder = path / "perception" / "random-last"
    folder.mkdir(parents=True)
    quality = {"position_error_px": 4.25, "baseline_error_px": 21.0, "attention_nll": 0.5, "visibility_bce": 0.1}
    frames = {"source": "random", "first_seed": 10_000_000, "episodes": 20, "steps": 50}
    values = {"checkpoint": "last", "env_steps": 1500, "frames": frames, "quality": {"clean": quality}}
    (folder / "quality.json").write_text(json.dumps(values))
    Image.fromarray(np.zeros((40, 60, 3), dtype=np.uint8)).save(folder / "attention.png")
    score = {"value": 0.75, "interval": [0.7, 0.8], "null": 0.51}
    probes = {"contact_auroc": score, "delta_dist_r2": score, "delta_obj_r2": score, "auroc_change": {"noise": score}}
    probed = path / "probe" / "expert-last" / "probes.json"
    probed.parent.mkdir(parents=True)
    probed.write_text(json.dumps({"frames": {}, "probes": {"policy_input": probes, "visual": None}}))
    episodes = [{"success_at_end": i < 3, "episode_return": 2.0} for i in range(4)]
    (path / "robustness").mkdir()
    (path / "robustness" / "policy.json").write_text(json.dumps({"rows": [], "episodes": {"noise": episodes}}))


@pytest.fixture(scope="module")
def report(tmp_path_factory, write_small_run):
    """A study with something of each kind, and its report."""
    folder = tmp_path_factory.mktemp("studies") / "runs"
    for seed in (0, 1):
        measure(write_small_run(folder, "slotfilm", seed, level=10.0 + seed, pretrained=True))
    for variant in ("state_only", "varpi_10", "slots_competitive"):
        write_small_run(folder, variant, 0, level=8.0)
    write_small_run(folder, "no_state", 0, over=False)
    costs = [{"variant": "slotfilm", "total_params": 2_910_000, "latency_ms_mean": 3.5, "device": "a test"}]
    (folder / "cost.json").write_text(json.dumps(costs))
    written = write_study(collect_study(folder), folder / "report")
    return written, Page(written.page.read_text(encoding="utf-8"))


def rows_of(written, name):
    with (written.page.parent / "tables" / f"{name}.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_every_item_of_the_paper_is_there_once_and_shown_or_named_missing(report):
    written, page = report
    for item in ITEMS:
        assert sum(heading.startswith(f"{item.number}: ") for heading in page.headings) == 1, item.number
    items = {entry["item"]: entry for entry in written.summary["items"]}
    assert list(items) == [item.number for item in ITEMS]
    assert {number for number, entry in items.items() if entry["shown"]} == SHOWN
    for number, entry in items.items():
        assert entry["shown"] or any(m["commands"] for m in entry["missing"]), number


def test_markdown_has_the_same_parts(report):
    written, page = report
    text = written.page.with_suffix(".md").read_text(encoding="utf-8")
    assert re.findall(r"^## (.*)$", text, re.M) == page.headings
    pictures = re.findall(r"^!\[.*\]\((.*)\)$", text, re.M)
    assert len(pictures) == len(page.sources)
    assert all((written.page.parent / name).is_file() for name in pictures)


def test_page_is_closed_html_and_loads_nothing_from_elsewhere(report):
    written, page = report
    assert page.open == []
    assert all(source.startswith("data:image/png;base64,") for source in page.sources)
    text = written.page.read_text(encoding="utf-8")
    assert not re.search(r"https?://|@import|<script|<link|url\(", text)
    assert written.page.stat().st_size < 3_000_000


def test_page_reads_without_pictures_and_its_links_lead_somewhere(report):
    _, page = report
    assert len(page.alts) >= 6
    assert all(len(alt) > 40 for alt in page.alts)
    assert len(set(page.ids)) == len(page.ids)
    assert {link.removeprefix("#") for link in page.links} == set(page.ids)
    assert page.header_cells > 50


def test_an_unfinished_run_is_drawn_but_counts_nowhere(report):
    written, _ = report
    assert written.summary["unfinished"] == ["no_state-s0"]
    assert {row["variant"] for row in rows_of(written, "variants")} == {
        "slotfilm",
        "state_only",
        "varpi_10",
        "slots_competitive",
    }


def test_tables_hold_values_intervals_and_empty_cells_for_the_undefined(report):
    written, _ = report
    rows = {row["variant"]: row for row in rows_of(written, "variants")}
    assert float(rows["slotfilm"]["last_return"]) == pytest.approx(93.5)
    assert float(rows["slotfilm"]["last_return_low"]) < 93.5 < float(rows["slotfilm"]["last_return_high"])
    assert rows["state_only"]["last_return_low"] == ""
    assert float(rows["state_only"]["improvement_last_return"]) == 0.0
    assert len(rows_of(written, "runs")) == 5


def test_what_the_paper_printed_stands_beside_what_was_measured(report):
    written, _ = report
    text = written.page.with_suffix(".md").read_text(encoding="utf-8").replace("\N{NO-BREAK SPACE}", " ")
    assert re.search(r"\| slotfilm \| 2 \| 93\.5 \[88\.5, 98\.5\] .*\| 3\.7 to 3\.9 k \|", text)
    assert re.search(r"\| Total parameters \| 2\.91 M \| 2\.91 M \|", text)
    assert re.search(r"\| slotfilm, policy input \| 2 \| 0\.750 ± 0\.000 \|", text)
    assert re.search(r"\| late, place \| 63\.6 ± 25\.9 \| 22\.2 \[22\.2, 22\.2\] \|", text)
    assert re.search(r"\| slotfilm, noise \| 6 of 8 \|", text)


def test_no_cell_says_nan(report):
    written, _ = report
    assert not re.search(r"\bnan\b|\bNone\b", written.page.with_suffix(".md").read_text(encoding="utf-8"))


def test_writing_again_removes_what_the_new_report_does_not_have(tmp_path, write_small_run):
    for variant in ("slotfilm", "varpi_1"):
        write_small_run(tmp_path / "runs", variant, 0)
    out = tmp_path / "out"
    write_study(collect_study(tmp_path / "runs"), out)
    (out / "figures" / "mine.png").write_bytes(b"kept")
    assert (out / "figures" / "figure-11.png").exists()
    (tmp_path / "runs" / "varpi_1-s0" / "config.json").unlink()
    write_study(collect_study(tmp_path / "runs"), out)
    assert not (out / "figures" / "figure-11.png").exists()
    assert not (out / "tables" / "figure-11-curves.csv").exists()
    assert (out / "figures" / "mine.png").exists()


def test_a_study_is_never_written_over_a_run(tmp_path, write_small_run):
    path = write_small_run(tmp_path, "slotfilm", 0)
    with pytest.raises(ValueError, match="a folder of its own"):
        write_study(collect_study(tmp_path), path)


def test_a_study_of_unfinished_runs_says_that_there_are_no_numbers(tmp_path, write_small_run):
    write_small_run(tmp_path, "state_only", 0, over=False)
    written = write_study(collect_study(tmp_path), tmp_path / "report")
    assert "No run is over yet" in written.page.read_text(encoding="utf-8")
    assert not (tmp_path / "report" / "tables" / "variants.csv").exists()


def write_grid(grid, command, *records):
    """What `slotfilm grid` leaves of itself in its directory."""
    (grid / "ledger").mkdir(parents=True)
    (grid / "grid.json").write_text(json.dumps({"settings": {}, "commands": [command]}))
    for record in records:
        (grid / "ledger" / f"{record['key']}.json").write_text(json.dumps(record))


FAILED = {"key": "cnn-s0-ab", "kind": "trial", "variant": "cnn", "seed": 0, "state": "failed", "error": "boom"}


def test_command_reports_a_run_or_a_study(tmp_path, write_small_run, capsys):
    path = write_small_run(tmp_path / "grid", "state_only", 0)
    write_grid(tmp_path / "grid", "slotfilm grid smoke", FAILED)
    assert main([str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"page": str(path / "report.html")}
    assert main([str(tmp_path / "grid"), "--json", "--out", str(tmp_path / "out")]) == 0
    values = json.loads(capsys.readouterr().out)
    assert values["page"] == str(tmp_path / "out" / "report.html")
    assert values["left_out"] == ["cnn-s0-ab: failed, boom."]
    missing = next(entry for entry in values["items"] if entry["item"] == "Figure 16")["missing"][0]
    assert missing["commands"] == ["slotfilm grid smoke --only slotfilm,end_to_end"]


def test_folder_of_grids_is_read_with_their_ledgers_and_commands(tmp_path, write_small_run, capsys):
    maker = write_small_run(tmp_path / "runs" / "first" / "making", "slotfilm", 1, pretrained=True)
    maker.rename(maker.with_name("encoder-ab"))
    made = {"key": "encoder-ab", "kind": "encoder", "variant": "slotfilm", "seed": 1, "state": "done"}
    write_grid(tmp_path / "runs" / "first", "slotfilm grid one", FAILED, made)
    write_small_run(tmp_path / "runs" / "second", "slotfilm", 0)
    write_grid(tmp_path / "runs" / "second", "slotfilm grid two")
    assert main([str(tmp_path / "runs"), "--json", "--out", str(tmp_path / "out")]) == 0
    values = json.loads(capsys.readouterr().out)
    assert [row["run"] for row in values["runs"]] == ["slotfilm-s0"]
    assert values["left_out"] == ["first/cnn-s0-ab: failed, boom."]
    items = {entry["item"]: entry for entry in values["items"]}
    assert items["Figure 3"]["shown"]
    assert items["Figure 16"]["missing"][0]["commands"] == ["slotfilm grid two --only end_to_end"]


def test_command_refuses_a_folder_for_the_page_of_a_run(tmp_path, write_small_run):
    path = write_small_run(tmp_path, "state_only", 0)
    with pytest.raises(ValueError, match="leave --out away"):
        main([str(path), "--out", str(tmp_path / "out")])


def test_commands_of_a_folder_with_a_blank_can_be_pasted(tmp_path, write_small_run):
    folder = tmp_path / "my runs"
    film = write_small_run(folder, "slotfilm", 0) / "film_strips" / "agent-7.png"
    film.parent.mkdir()
    Image.fromarray(np.zeros((40, 60, 3), dtype=np.uint8)).save(film)
    text = write_study(collect_study(folder), tmp_path / "out").page.with_suffix(".md").read_text(encoding="utf-8")
    assert f"slotfilm evaluate '{folder}/slotfilm-s0' --what film_strips --seed 7 --episodes 1" in text
    assert f"slotfilm cost --json > '{folder}/cost.json'" in text


@pytest.mark.parametrize(("form", "highest"), [("bounded", "500"), ("inverse", "2 750")])
def test_highest_return_follows_from_the_reward(tmp_path, write_small_run, small_base, form, highest):
    reward = dataclasses.replace(small_base.reward, near_form=form)
    write_small_run(tmp_path, "slotfilm", 0, base=dataclasses.replace(small_base, reward=reward))
    text = write_study(collect_study(tmp_path), tmp_path / "report").page.with_suffix(".md").read_text(encoding="utf-8")
    assert f"At most {highest} in an episode of 50 steps" in text.replace("\N{NO-BREAK SPACE}", " ")
