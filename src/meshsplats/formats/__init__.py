"""Files. Readers return physical values, writers take them; logits, logs and axis flips stay in here.

``splats`` chooses the reader of a splat file by content, ``meshes`` the reader and writer of a mesh; each
file format has a module of its own with reading and writing side by side.
"""
