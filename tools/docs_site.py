"""Makes the documents a site; ``make docs`` runs it:

    python tools/docs_site.py -o site --page scene.html

Documents keep the places that they have in the repository, so the same links work in both; README.md is the
first page, with a scene of ``meshsplats view`` in it (``--page``). A page for each group of public names
comes from their docstrings, and one shows the examples. The site works from the disk, with its search, and
loads nothing from other servers. It appears whole or not at all: broken links and anchors, docstrings that
cannot be read and public names without a page are errors.

Needs the packages of ``tools/docs-requirements.txt``.
"""

from __future__ import annotations

import argparse
import posixpath
import re
import shutil
import subprocess
import sys
import tempfile
from functools import cache
from html.parser import HTMLParser
from importlib import import_module
from pathlib import Path
from urllib.parse import unquote, urlsplit

ROOT = Path(__file__).resolve().parents[1]
NAVIGATION = {
    "Tutorials": [
        *("docs/tutorials/from_a_splat_file", "docs/tutorials/places", "docs/tutorials/from_photographs")
    ],
    "Using it": [
        *("docs/install", "docs/commands", "docs/python", "docs/pipelines", "docs/files", "docs/viewer"),
        *("docs/blender", "docs/viewers", "docs/quality", "docs/view-dependent-colour"),
        *("docs/finetuning", "docs/training", "docs/datasets", "docs/surfaces", "docs/mesh-prior"),
        *("docs/large-captures", "docs/levels", "docs/tiles", "docs/cluster", "docs/webgpu"),
        *("docs/options", "docs/terms", "examples"),
    ],
    "Python": [],  # the reference
    "How it works": [
        *("docs/method", "docs/conventions", "docs/architecture", "docs/webgpu-host"),
        "benchmarks/RESULTS",
    ],
    "The project": ["CHANGELOG", "CONTRIBUTING", "docs/releasing", "SECURITY", "license"],
}
"""Pages by section. Documents that are not listed come last in "Using it"."""
RESULTS = "benchmarks/results/"
"""Pages below that of the benchmarks."""
REFERENCE = {
    "Splats and meshes": [
        *("GaussianCloud", "SplatMesh", "load_gaussians", "save_gaussians", "load_mesh", "save_mesh"),
        *("gaussians_from_tensors", "gaussians_to_tensors"),
        *("convert", "ConversionOptions", "simplify", "bake_filter", "cut_mesh"),
    ],
    "Cameras and images": [
        *("Camera", "orbit", "dome", "look_at", "look_around", "load_cameras", "save_cameras"),
        *("render", "render_splats", "Rendering", "draw_splats", "needed_samples", "rasterize", "save_image"),
    ],
    "Data sets and scores": [
        *("Dataset", "View", "ViewImage", "load_dataset", "splat_dataset", "find_background"),
        *("compare", "Comparison", "evaluate", "Report", "psnr", "ssim"),
    ],
    "Fine-tuning": [
        *("finetune", "FinetuneConfig", "make_config", "starting_mesh", "RunOptions", "Progress"),
        "Interrupted",
    ],
    "Surfaces": ["make_surface", "SurfaceOptions", "draw_surface", "load_vertex_colored", "save_base"],
    "Mesh priors": ["BaseMesh", "load_base", "bind", "MeshPrior", "load_prior", "train_prior"],
    "Work with files": [
        *("operations.edits.clean_file", "operations.edits.simplify_file", "operations.edits.bake_file"),
        *("operations.options.SimplifyOptions", "operations.options.BakingOptions"),
        *("renders.saving.ImageRun", "renders.options.ImageOptions"),
        *("evaluation.comparison_files.save_comparison", "evaluation.options.ComparisonOptions"),
        *("operations.scoring.Scoring", "operations.options.ScoringOptions"),
        *("operations.chains.make_chain", "operations.options.ChainOptions"),
        *("prior.planning.save_poses", "prior.planning.pose_files", "operations.inspection.describe"),
    ],
    "Errors": [
        *("FileFormatError", "MissingDependencyError", "DivergenceError", "DeviceError", "ClusterError"),
        *("OtherRunError", "DataWarning", "NoTextureWarning"),
    ],
}
"""Public names by page, and some of modules; names that are not listed come last."""


PLACE_OF_SCENE = "<!-- On the site, the scene itself is here. -->"
"""What the scene of ``--page`` replaces in README.md."""
SCENE = "live/scene.html"
"""Place of its page on the site."""
TITLE = "<title>MeshSplats</title>"
"""Of the first page, as docs/conf.py has it."""
MOST_BYTES = 5_000_000
"""Of the page: visitors wait for it."""


# Pages


def frame_of_scene(address: str) -> str:
    """HTML that shows the page at ``address`` inside another page."""
    return (
        f'<iframe src="{address}" title="A still life of splats, as a mesh and as splats: drag to turn"'
        ' loading="lazy" allow="fullscreen" style="width: 100%; height: 30rem; border: 0"></iframe>'
    )


@cache
def public_names() -> frozenset[str]:
    """The names that ``import meshsplats`` offers."""
    sys.path.insert(0, str(ROOT / "src"))
    from meshsplats import _MODULES

    return frozenset(_MODULES)


def _is_in_module(name: str) -> bool:
    """Whether ``name`` is that of a module of the package and of what it defines."""
    module, _, inner = f"meshsplats.{name}".rpartition(".")
    return module != "meshsplats" and hasattr(import_module(module), inner)


@cache
def reference_pages() -> dict[str, str]:
    """Pages of the Python reference by name, without suffix."""
    names = public_names()
    listed = {name for group in REFERENCE.values() for name in group}
    if unknown := sorted(name for name in listed - names if not _is_in_module(name)):
        raise SystemExit(f"tools/docs_site.py lists what meshsplats does not have: {', '.join(unknown)}")
    groups = dict(REFERENCE)
    if rest := sorted(names - listed):
        groups["More"] = rest
    pages = {}
    for title, group in groups.items():
        entries = []
        for name in group:
            entry = (
                f".. autoclass:: meshsplats.{name}\n   :members:"
                if name.rpartition(".")[2][0].isupper()
                else f".. autofunction:: meshsplats.{name}"
            )
            entries.append(f"## {name}\n\n```{{eval-rst}}\n{entry}\n```\n")
        pages["reference/" + title.lower().replace(" ", "-")] = f"# {title}\n\n" + "\n".join(entries)
    return pages


@cache
def example_files() -> dict[str, str]:
    """The heading of each example, by its place in the repository."""
    files = sorted((ROOT / "examples").rglob("*.py"))
    places = [path.relative_to(ROOT).as_posix() for path in files]
    return {place: place.removeprefix("examples/").removesuffix(".py").replace("/", " ") for place in places}


def examples_page() -> str:
    parts = ["# Examples\n\nRun them from the root of the repository.\n"]
    for place, heading in example_files().items():
        source = (ROOT / place).read_text(encoding="utf-8").rstrip()
        parts.append(f"## {heading}\n\n````python\n{source}\n````\n")
    return "\n".join(parts)


def navigation(pages: list[str]) -> str:
    """Tables of contents for the side bar; ``pages`` are all pages, without suffix."""
    sections = {title: list(names) for title, names in NAVIGATION.items()}
    sections["Python"] = list(reference_pages())
    listed = {name for names in sections.values() for name in names}
    listed |= {page for page in pages if page.startswith(RESULTS)}
    sections["Using it"] += sorted(set(pages) - listed - {"index"})
    tables = [
        "```{{toctree}}\n:hidden:\n:caption: {}\n\n{}\n```\n".format(title, "\n".join(names))
        for title, names in sections.items()
    ]
    return "\n" + "\n".join(tables)


def moved_links(text: str, here: str) -> str:
    """Links of a document at ``here`` to what has another place on the site."""
    places = {"README.md": "index.md", "LICENSE": "license.md", "examples": "examples.md"}
    for place, heading in example_files().items():
        places[place] = "examples.md#" + heading.lower().replace(" ", "-")

    def moved(match: re.Match[str]) -> str:
        target, _, anchor = match[1].partition("#")
        place = places.get(posixpath.normpath(posixpath.join(posixpath.dirname(here), target)))
        if place is None or not target:
            return match[0]
        link = posixpath.relpath(place, posixpath.dirname(here) or ".")
        return f"]({link}{'#' + anchor if anchor else ''})"

    return re.sub(r"\]\(([\w./#-]+)\)", moved, text)


def write_sources(folder: Path, scene: bool) -> None:
    """All that Sphinx reads. ``scene``: whether the first page shows one."""
    documents = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]
    documents += sorted((ROOT / "benchmarks").rglob("*.md"))
    texts = {path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8") for path in documents}
    texts = {place: moved_links(text, place) for place, text in texts.items()}
    texts |= {f"{name}.md": text for name, text in reference_pages().items()}
    texts["examples.md"] = examples_page()
    license_text = (ROOT / "LICENSE").read_text(encoding="utf-8").rstrip()
    texts["license.md"] = f"# Licence\n\n```text\n{license_text}\n```\n"
    below = "\n".join(place.removesuffix(".md") for place in texts if place.startswith(RESULTS))
    texts["benchmarks/RESULTS.md"] += (
        f"\n```{{toctree}}\n:hidden:\n\n{below.replace(RESULTS, 'results/')}\n```\n"
    )
    index = texts.pop("README.md")
    if scene:
        if PLACE_OF_SCENE not in index:
            raise SystemExit(f"README.md has no line {PLACE_OF_SCENE}")
        index = index.replace(PLACE_OF_SCENE, f"```{{raw}} html\n{frame_of_scene(SCENE)}\n```")
    texts["index.md"] = index + navigation([place.removesuffix(".md") for place in [*texts, "index.md"]])
    for place, text in texts.items():
        (folder / place).parent.mkdir(parents=True, exist_ok=True)
        (folder / place).write_text(text, encoding="utf-8", newline="\n")
    shutil.copytree(ROOT / "docs/images", folder / "docs/images")


# Checks


class Page(HTMLParser):
    """Anchors of a page, its links, and what a browser loads to show it."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        if anchor := values.get("id"):
            self.anchors.add(anchor)
        if source := values.get("src"):
            self.loaded.append(source)
        if link := values.get("href"):
            loads = tag == "link" and values.get("rel") in ("stylesheet", "icon", "preload", "preconnect")
            (self.loaded if loads else self.links).append(link)


def problems_of(site: Path) -> list[str]:
    """Broken links and anchors, things loaded from elsewhere, and public names without an entry."""
    pages = {path: Page(path.read_text(encoding="utf-8")) for path in site.rglob("*.html")}
    problems = []
    for path, page in pages.items():
        name = path.relative_to(site).as_posix()
        problems += [f"{name} loads {link}" for link in page.loaded if urlsplit(link).netloc]
        for link in page.links + page.loaded:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if not target.is_file() or not target.is_relative_to(site):
                problems.append(f"{name}: {link} leads nowhere")
            elif parts.fragment and target in pages and unquote(parts.fragment) not in pages[target].anchors:
                problems.append(f"{name}: {link} has no such anchor")
    pattern = r"(?:url\(|@import)\s*[\"']?((?:https?:)?//[^)\"']+)"
    for sheet in site.rglob("*.css"):
        found = re.findall(pattern, sheet.read_text(encoding="utf-8"))
        problems += [f"{sheet.relative_to(site)} loads {link}" for link in found]
    anchors = set().union(*(page.anchors for page in pages.values()))
    problems += [
        f"no entry for {name}" for name in sorted(public_names()) if f"meshsplats.{name}" not in anchors
    ]
    return problems


def check_output(folder: Path) -> None:
    """SystemExit if ``folder``, which is replaced, holds anything but a site that was made here."""
    if folder.exists() and not folder.is_dir():
        raise SystemExit(f"{folder} is a file: -o takes a folder")
    names = {path.name for path in folder.iterdir()} if folder.exists() else set()
    # Nothing in a site that was made here is hidden, as .git would be.
    made_here = {"index.html", "searchindex.js"} <= names and not any(name.startswith(".") for name in names)
    if names and not (made_here and TITLE in (folder / "index.html").read_text(encoding="utf-8")):
        raise SystemExit(
            f"{folder} would be replaced, but is no site that was made here; "
            "name another folder after -o, or empty this one"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description="Makes the documents a site.")
    parser.add_argument("-o", "--output", type=Path, default=Path("site"), help="folder of the site")
    parser.add_argument("--page", type=Path, help="page of meshsplats view, for the first page")
    arguments = parser.parse_args()
    output, page = arguments.output.resolve(), arguments.page
    check_output(output)
    if page is not None and page.stat().st_size > MOST_BYTES:
        raise SystemExit(f"{page} has {page.stat().st_size:,} bytes, more than {MOST_BYTES:,}")
    output.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=output.parent, prefix=".site-") as scratch:
        sources, site = Path(scratch, "sources"), Path(scratch, "site").resolve()
        write_sources(sources, page is not None)
        command = [sys.executable, "-m", "sphinx", "-b", "html", "-c", str(ROOT / "docs"), "-q"]
        command += ["--fail-on-warning", "--keep-going", "-d", f"{scratch}/doctrees", str(sources), str(site)]
        if subprocess.run(command).returncode:
            raise SystemExit("the site was not made")
        if page is not None:
            (site / SCENE).parent.mkdir()
            shutil.copyfile(page, site / SCENE)
        if problems := problems_of(site):
            raise SystemExit("\n".join(["the site was not made:", *problems]))
        for name in (".buildinfo", "objects.inv"):
            (site / name).unlink(missing_ok=True)
        shutil.rmtree(output, ignore_errors=True)
        site.replace(output)
    print(f"{output / 'index.html'}")


if __name__ == "__main__":
    main()
