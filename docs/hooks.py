"""What MkDocs needs beside the pages: the navigation, pages of experiments, the notebook, the API's pages.

Pages link to ``../experiments/...`` as they lie in the repository; in the site that folder is inside.
"""

from __future__ import annotations

import base64
import importlib
import json
import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOK = "notebooks/first_look.ipynb"

#: Rooms of the package and the modules of each whose public names others build on.
API = {
    "motion": "motion rotations skeleton kinematics mapping retarget contacts ground io",
    "humanoid": "config model from_motion physics boxes derivatives trajectory state_layout",
    "vision": "video flow lens head_signal head_film camera_rotation features encoders rendering rooms takes "
    "body_parts body_part_pictures",
    "data": "take_sources preparation prepare_motion sync_offset store splits feasibility gate",
    "models": "policy context episode_context regressor pose_regression predictions mirror",
    "envs": "imitation tracking problem env dm_control_task starts transforms target_window "
    "mdp.observations mdp.path mdp.rewards mdp.step_view mdp.terminations",
    "tasks": "task dataset",
    "collection": "collectors",
    "checkpoint": "checkpoint pretrained body_parts",
    "training": "loop ppo regressor teacher cloning body_parts survival",
    "pipeline": "agent dataset environment run tracker",
    "inference": "estimator failsafe forecaster planner bands",
    "evaluation": "metrics position_metrics protocols statistics agents",
}


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """The navigation: guides of verbs are found by their names, so that a new one needs no entry."""
    docs = Path(config.docs_dir)
    guides = sorted(path.name for path in docs.glob("howto-*.md"))
    first = ["quickstart.md", "concepts.md", NOTEBOOK.replace(".ipynb", ".md"), "own-data.md", "commands.md"]
    known = {"index.md", *first, *guides}
    others = [p.name for p in sorted(docs.glob("*.md")) if p.name not in known]
    studies = [f"experiments/{p.parent.name}/README.md" for p in sorted((ROOT / "experiments").glob("*/README.md"))]
    config.nav = [
        {"Home": "index.md"},
        {"Start": first},
        {"How to": guides},
        {"In depth": others},
        {"Experiments": studies},
        {"API": [f"api/{room}.md" for room in API]},
    ]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add pages that do not lie in ``docs/``."""
    for path in sorted((ROOT / "experiments").rglob("*")):
        if path.suffix in (".md", ".png", ".svg") and "raw" not in path.parts:
            name = str(path.relative_to(ROOT))
            files.append(File.generated(config, name, abs_src_path=str(path)))
    for room, modules in API.items():
        text = "".join(f"\n::: egopose.{room}.{module}\n" for module in modules.split())
        files.append(File.generated(config, f"api/{room}.md", content=f"# egopose.{room}\n{text}"))
    notebook = json.loads((ROOT / "docs" / NOTEBOOK).read_text())
    files.append(File.generated(config, NOTEBOOK.replace(".ipynb", ".md"), content=notebook_page(notebook)))
    files.append(File.generated(config, "commands.md", content=commands_page()))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Links to and from the folder of experiments, and to the notebook."""
    if page.file.src_uri.startswith("experiments/"):
        return markdown.replace("](../../docs/", "](../../")
    markdown = markdown.replace(f"]({NOTEBOOK})", f"]({NOTEBOOK.replace('.ipynb', '.md')})")
    return markdown.replace("](../experiments/", "](experiments/") if "/" not in page.file.src_uri else markdown


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Docstrings name things with Sphinx's roles, which Markdown does not know."""
    return re.sub(r":(?:class|func|mod|meth|attr|data):(?=<code>)", "", html)


def notebook_page(notebook: dict[str, Any]) -> str:
    """A notebook with its outputs, as Markdown."""
    parts = []
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        for output in cell["outputs"]:
            data = output.get("data", {})
            if "image/png" in data:
                picture = base64.b64encode(base64.b64decode("".join(data["image/png"]))).decode()
                parts.append(f'<img alt="the plot made by the lines above" src="data:image/png;base64,{picture}">')
            elif text := "".join(output.get("text", data.get("text/plain", ""))):
                parts.append(f"```text\n{text.rstrip()}\n```")
    parts.append("The notebook itself is `docs/notebooks/first_look.ipynb`; it is run by `tests/core/test_docs.py`.")
    return "\n\n".join(parts)


def commands_page() -> str:
    """Every verb of the command, its guide, and the settings of its configuration as they stand in ``conf/``."""
    sys.path.insert(0, str(ROOT / "src"))
    verbs = importlib.import_module("egopose.__main__").VERBS
    rows = ["# The command", "", "`egopose VERB [key=value ...]`; `python -m egopose.VERB` is the same.", ""]
    rows += ["| verb | what it does | guide |", "| --- | --- | --- |"]
    guides = {"sync": "own-data.md", "demo": "quickstart.md", "baseline": "howto-baselines.md"}
    for verb, what in verbs.items():
        guide = guides.get(verb, f"howto-{verb}.md")
        link = f"[{guide}]({guide})" if (ROOT / "docs" / guide).is_file() else ""
        rows.append(f"| `{verb}` | {what} | {link} |")
    rows += ["", "Names and values are completed by the shell after", "", "```bash"]
    rows += ['eval "$(egopose completion bash)"    # or zsh', "```", "", "## Settings", ""]
    rows += ["Each verb reads one file of `conf/`, whose groups are folders; every value has its source beside it.", ""]
    for verb in verbs:
        path = ROOT / "conf" / f"{verb}.yaml"
        if path.is_file():
            text = re.sub(r"\nhydra:\n(?:[ \t].*\n|\n)*", "\n", path.read_text())
            rows += [f"### {verb}", "", "```yaml", text.rstrip(), "```", ""]
    return "\n".join(rows)
