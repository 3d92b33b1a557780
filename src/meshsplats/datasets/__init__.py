"""Views to train and test with: photographs in folders, one module per layout, or images of splats."""
