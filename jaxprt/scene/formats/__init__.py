"""Readers of file formats: glTF, OBJ with MTL, dictionaries of Mitsuba, and mesh formats that trimesh reads."""
