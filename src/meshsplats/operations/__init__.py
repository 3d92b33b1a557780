"""What a command does with the files of a scene, from its inputs to its outputs, for any program."""
