"""Readers of file formats: glTF, OBJ with MTL, PLY, OFF, STL, and dictionaries of Mitsuba."""
