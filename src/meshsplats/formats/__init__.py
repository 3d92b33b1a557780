"""Readers and writers of files. They take and return physical values: logits, logs and axis flips stay here.

``sniff`` recognises files by content. ``gaussians`` chooses the reader and writer of splats, ``meshes`` those
of meshes, ``base_meshes`` reads meshes with textures. Each family of formats has a folder.
"""
