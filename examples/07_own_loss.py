"""Fine-tuning with a loss of your own.

python examples/07_own_loss.py [steps]      Writes into example-output/.
"""

import sys
from pathlib import Path

import numpy as np

import meshsplats as ms
from meshsplats.demo_scene import make_scene


def charbonnier(image, target):
    """Nearly the mean of |image - target|, but smooth; and its gradient by every number of the image."""
    difference = image - target.color
    smooth = np.sqrt(difference**2 + 1e-4)
    return smooth.mean(), difference / smooth / smooth.size


out = Path("example-output")
out.mkdir(exist_ok=True)
data = ms.splat_dataset(make_scene(), train=12, test=4, width=96, sh_degree=0)
mesh = ms.convert(make_scene(), cameras=[view.camera for view in data.train])
tuned = ms.finetune(mesh, data, steps=int(sys.argv[1]) if len(sys.argv) > 1 else 48, loss=charbonnier)
ms.save_mesh(tuned, out / "own_loss.npz")
before, after = (ms.evaluate(one, data).methods[0].mean("psnr") for one in (mesh, tuned))
print(f"held out: {before:.1f} -> {after:.1f} dB, {out / 'own_loss.npz'}")
