"""``meshsplats view``: a scene in the browser, or a page of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from meshsplats._files.atomic import in_words, write_text
from meshsplats.cli import option
from meshsplats.cli.arguments import Command, Flat, as_cli_options
from meshsplats.cli.common import PartOptions, SplatOptions, named
from meshsplats.cli.messages import UsageError, say, shown_path
from meshsplats.cli.records import write_configuration
from meshsplats.formats.outputs import CONFIGURATION, beside, check_outputs
from meshsplats.formats.splat_paths import subject_name
from meshsplats.viewer import content
from meshsplats.viewer.content import Content
from meshsplats.viewer.files import EXCLUSIVE, ViewingOptions, shown_file

if TYPE_CHECKING:
    from meshsplats.viewer.page import Page


@as_cli_options(presets=False)
class ViewerOptions(ViewingOptions):
    reading: SplatOptions
    part: PartOptions


@dataclass(frozen=True)
class View(Command):
    """Shows splats or a mesh in the browser, exactly, the splats beside it for comparison; or a textured
    surface; or writes a page that anyone can open with a double click (-o scene.html).

    Splats are converted to a mesh first, with default settings; very large clouds are simplified before that.
    Nothing leaves this machine: the browser loads the scene from 127.0.0.1 until Ctrl-C.
    """

    EXCLUSIVE = EXCLUSIVE
    CONFIGURABLE = True

    input: tyro.conf.Positional[Path]
    """Splats, a model folder, a mesh, or a surface with a texture (.glb, .obj)."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FILE", help_behavior_hint="")] = (
        None
    )
    """An .html file with everything inside. Default: the browser is opened."""
    viewing: Annotated[ViewerOptions, Flat] = field(default_factory=ViewerOptions)
    no_open: bool = False
    """Print the address, and open no browser."""
    threads: option.Threads = None
    json: option.AsJson = False
    force: option.Force = False

    def execute(self) -> None:
        self._check()
        viewing = self.viewing
        viewing.check()
        if self.output is not None:
            inputs = filter(None, [self.input, viewing.splats, viewing.surface, viewing.cameras])
            check_outputs([self.output, beside(self.output, CONFIGURATION)], self.force, inputs=[*inputs])
        shown = shown_file(self.input, viewing, say=say, threads=self.threads)
        self._announce(shown.content)
        name = shown_path(self.input)
        page, result = shown.page("scene" if name == "-" else subject_name(Path(name).resolve()))
        if self.output is not None:
            self._write(self.output, page, result)
        else:
            self._serve(page, result)

    def _check(self) -> None:
        if self.output is not None and self.output.suffix.lower() not in (".html", ".htm"):
            raise UsageError(f"-o must end in .html, got {self.output.name!r}")
        if self.output is not None and self.no_open:
            raise UsageError("--no-open has no effect with -o, which opens nothing")
        if self.output is None and self.force:
            raise UsageError("--force has no effect without -o")

    def _announce(self, shown: Content) -> None:
        """Says what was merged, and how large the file will be, before the work of packing it."""
        if self.json:
            return  # the result has the same numbers
        if shown.merged_from is not None:
            say(
                f"{shown.merged_from:,} splats were merged to {shown.kept:,}: an image of them with"
                f" {content.SIDE} pixels has {shown.merging_psnr:.1f} dB against that of all;"
                " --max-triangles N or --whole keeps more"
            )
        if self.output is not None:
            size = in_words(shown.estimated_size())
            say(f"{self.output} will have about {size}: {content.in_words(shown.counts())}")

    def _write(self, output: Path, page: Page, result: dict[str, Any]) -> None:
        write_text(output, page.html)
        write_configuration(beside(output, CONFIGURATION), "view", self, result)
        self.finish(
            {"page": str(output), **result},
            f"{named(output)}: {content.in_words(result)}",
            content.errors_in_words(result),
            "next: open it with a double click, or send it to someone: it needs no network; iPhones and iPads"
            " open it from a web server only",
        )

    def _serve(self, page: Page, result: dict[str, Any]) -> None:
        from meshsplats.viewer.server import open_page, serving

        with serving(page.html) as server:
            about = [content.in_words(result), content.errors_in_words(result), server.url, "Ctrl-C ends"]
            self.finish({"url": server.url, **result}, *about, indent=None)
            if not self.no_open and not open_page(server.url):
                say("no browser was found: open the address above in one, on this machine")
            try:
                server.serve_forever()
            except KeyboardInterrupt:
                say("ended")
