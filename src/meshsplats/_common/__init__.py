"""What every room uses: checks of arguments, options, geometry, parsing, and words for messages."""
