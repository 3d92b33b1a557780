"""Readers and writers of files. They take and return physical values: logits, logs and axis flips stay here.

``splat_formats`` is the table of splat formats, ``sniff`` recognises files by content. ``gaussians`` reads
and writes splats, ``streaming`` reads them in blocks, ``meshes`` chooses the reader and writer of meshes,
``base_meshes`` reads meshes with textures. Each family of formats has a folder.
"""
