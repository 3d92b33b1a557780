"""Files of meshes whose colours depend on the view: size, and what the 8 bits of a .glb cost.

    python benchmarks/view_colors.py SPLATS ...

For each degree the conversion is saved and read again. dB compare the image of the file with that of the
mesh, four views of ``orbit(cloud, 4, elevation=20)`` on white, 400 pixels wide. ``texcoords`` is `.glb` for
engines, ``meshopt`` is compressed, ``tiles`` a tileset, of which the leaves are drawn.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from _common import Report, arguments, mean_psnr

import meshsplats as ms
from meshsplats.conversion import ConversionOptions

FILES = {
    "glb": (".glb", {}),
    "texcoords": (".glb", {"harmonics": "texcoords"}),
    "meshopt": (".glb", {"compression": "meshopt"}),
    "ply": (".ply", {}),
    "npz": (".npz", {}),
}
READ = ("glb", "texcoords", "meshopt")
"""Those that are read again."""


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("splats", nargs="+")
    parser.add_argument("--threads", type=int)
    options = parser.parse_args()
    with Report(options) as report, tempfile.TemporaryDirectory() as folder:
        report.table(
            *("scene", "degree", "triangles", *(f"{n} MB" for n in FILES), "tiles MB"),
            *(f"{n} dB" for n in (*READ, "tiles")),
        )
        for name in options.splats:
            cloud = ms.load_gaussians(name)
            mesh = ms.convert(cloud)
            cameras = ms.orbit(cloud, 4, elevation=20, width=400, height=400)
            for degree in range(mesh.sh_degree + 1):
                part, sizes, scores = mesh.of_degree(degree), [], []
                wanted = [ms.render(part, c, threads=options.threads).color for c in cameras]
                for kind, (suffix, more) in FILES.items():
                    path = Path(folder) / f"mesh{suffix}"
                    ms.save_mesh(part, path, **more)
                    sizes.append(f"{path.stat().st_size / 1e6:.1f}")
                    if kind in READ:
                        read = ms.load_mesh(path)
                        shown = [ms.render(read, c, threads=options.threads).color for c in cameras]
                        scores.append(f"{mean_psnr(shown, wanted):.1f}")
                tiles = Path(folder) / f"tiles {degree}"
                colors = ConversionOptions(colors="view", color_degree=degree) if degree else None
                made = ms.build_tiles(
                    ms.stream_gaussians(name), tiles, ms.TileOptions(alpha="mask", conversion=colors)
                )
                tileset = ms.Tileset(tiles)
                shown = [
                    ms.render_tiles(tileset, camera, max_error=0, threads=options.threads).color
                    for camera in cameras
                ]
                sizes.append(f"{made.bytes / 1e6:.1f}")
                scores.append(f"{mean_psnr(shown, wanted):.1f}")
                report.row(Path(name).stem, degree, f"{len(part.faces):,}", *sizes, *scores)


if __name__ == "__main__":
    main()
