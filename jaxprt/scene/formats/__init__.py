"""Readers of files: meshes and scenes in glTF, OBJ with MTL, Mitsuba's dictionaries, and what trimesh reads."""
