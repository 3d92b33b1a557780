"""What runs inside Blender, 4.2 or newer: needs its module bpy and NumPy, nothing else.

The command line runs it through ``worker``; Blender's extension imports it directly.
"""
