"""Viewpoints: from where a scene of splats was photographed, found from the splats alone."""
