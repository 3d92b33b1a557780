"""The viewer: a page that shows a mesh in a browser, exactly, in one file."""
