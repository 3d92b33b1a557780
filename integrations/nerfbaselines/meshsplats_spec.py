"""Registers MeshSplats with nerfbaselines: NERFBASELINES_REGISTER=/path/to/meshsplats_spec.py."""

from nerfbaselines import register

register(
    {
        "id": "meshsplats",
        "method_class": "meshsplats_method:MeshSplats",
        "conda": {
            "environment_name": "meshsplats",
            "python_version": "3.11",
            "install_script": "pip install /path/to/meshsplats\n",  # yours: a clone or a wheel
        },
        "metadata": {
            "name": "MeshSplats",
            "description": "A mesh of translucent triangles, trained on photographs without splats.",
            "paper_link": "https://arxiv.org/abs/2502.07754",
        },
    }
)
