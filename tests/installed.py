"""Uses an installed jaxprt as a user would, without the repository: `make dist` runs it in an empty environment.

Its one argument is the repository, from which nothing may be imported.
"""

import pathlib
import subprocess
import sys
import tempfile

import jaxprt as prt


def main(repository: str) -> None:
    package = pathlib.Path(prt.__file__).resolve()
    if pathlib.Path(repository).resolve() / "jaxprt" in package.parents:
        raise SystemExit(f"the installed package must be used, got {package}")
    for name in ("py.typed", "view/browser/viewer.js"):
        if not (package.parent / name).is_file():
            raise SystemExit(f"the wheel must hold jaxprt/{name}")

    mesh = prt.scene.builtin.sphere(rings=16, sectors=32)
    relit = prt.precompute(prt.Scene([prt.Part("ball", mesh, prt.brdf.Lambert(1.0))]), refine=False, system="harmonic")
    furnace = prt.Environment(prt.scene.builtin.studio(size=16).radiance * 0 + 1)
    radiance = relit.radiance(furnace, eye=relit.camera.eye)
    if not abs(radiance - 1).max() < 0.01:
        raise SystemExit(
            f"a white sphere in a white furnace must have radiance 1, got {radiance.min()} to {radiance.max()}"
        )
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "ball.png"
        prt.files.write_png(path, prt.image.display(relit.picture(prt.scene.builtin.studio(size=32))))
        size = path.stat().st_size
        print(f"jaxprt {prt.__version__}: white furnace {radiance.min():.4f} to {radiance.max():.4f}, {size} bytes")
    subprocess.run([sys.executable, "-I", "-m", "jaxprt", "--help"], check=True, stdout=subprocess.DEVNULL)


if __name__ == "__main__":
    main(sys.argv[1])
