"""A library of furniture as Sweet Home 3D's: every piece is one box."""

import zipfile

# name, category, width, depth, height and height above the floor in cm; at least one of each group
STOCK = [
    ("Chair", "Living room", 45, 50, 90, 0), ("Chair", "Office", 60, 60, 95, 0),
    ("Armchair", "Living room", 80, 80, 80, 0), ("Stool", "Kitchen", 40, 40, 75, 0),
    ("Sofa", "Living room", 190, 85, 80, 0), ("Table", "Living room", 140, 80, 75, 0),
    ("Coffee table", "Living room", 100, 60, 45, 0), ("Bar table", "Living room", 70, 70, 102, 0),
    ("Desk", "Office", 140, 70, 72, 0), ("Wardrobe", "Bedroom", 100, 60, 200, 0),
    ("Chest", "Bedroom", 90, 45, 80, 0), ("Bedside table", "Bedroom", 45, 40, 45, 0),
    ("TV stand", "Living room", 130, 45, 50, 0), ("Lower cabinet", "Kitchen", 60, 60, 88, 0),
    ("Upper cabinet", "Kitchen", 60, 32, 72, 145), ("Bookcase", "Living room", 90, 35, 190, 0),
    ("TV", "Living room", 60, 20, 45, 0), ("Wall flat TV", "Living room", 100, 10, 60, 100),
    ("Desk lamp", "Lights", 20, 20, 40, 0), ("Lamp", "Lights", 30, 30, 120, 0),
    ("Hanging light", "Lights", 40, 40, 60, 180), ("Wall light", "Lights", 20, 20, 30, 140),
    ("Dustbin", "Office", 25, 25, 35, 0), ("Oriental rug", "Living room", 180, 120, 2, 0),
    ("Cactus", "Living room", 15, 15, 25, 0), ("Clock", "Bedroom", 10, 5, 10, 0),
    ("Frame A", "Miscellaneous", 14, 14, 20, 0), ("Book", "Miscellaneous", 28, 18, 3, 0),
    ("Double window", "Doors and windows", 110, 20, 120, 90),
    ("Door", "Doors and windows", 90, 15, 205, 0), ("Curtain", "Miscellaneous", 60, 5, 200, 8),
    ("Bed", "Bedroom", 160, 210, 60, 0), ("Fridge", "Kitchen", 60, 60, 130, 0),
    ("Sink", "Kitchen", 80, 60, 90, 0), ("Hood", "Kitchen", 60, 40, 40, 180),
    ("Bath", "Bathroom", 160, 70, 60, 0), ("Radiator", "Miscellaneous", 80, 10, 60, 10),
    ("Toaster", "Kitchen", 27, 15, 17, 0), ("Vase", "Miscellaneous", 20, 20, 30, 0),
    ("Suitcase", "Miscellaneous", 70, 25, 50, 0),
    ("Cuckoo clock", "Miscellaneous", 25, 18, 70, 100),
    # these belong to no group: a lamp that hangs where one should stand, a sofa as long as a wall
    ("Lamp", "Lights", 30, 30, 40, 150), ("Sofa", "Living room", 400, 85, 80, 0),
]  # fmt: skip
MORE = {  # other properties, by name: nothing is put there; lies on its back; no file of colours
    "Chest": "dropOnTopElevation#{}=-1",
    "Book": "modelRotation#{}=1 0 0 0 0 1 0 -1 0",
    "Vase": "model#{}=/bare/bare.obj",
}
BOX = """mtllib box.mtl
v 0 0 0\nv 2 0 0\nv 2 1 0\nv 0 1 0\nv 0 0 3\nv 2 0 3\nv 2 1 3\nv 0 1 3
usemtl red
f 1/1/1 2/2/2 3/3/3 4/4/4
f 5 6 7 8
usemtl other
f 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf -5 -8 -4 -1
"""


def write_library(folder):
    """Write the library into a folder, which is returned."""
    lines = ["# a comment"]
    for k, (name, category, *sizes) in enumerate(STOCK, 1):
        keys = zip(("width", "depth", "height", "elevation"), sizes, strict=True)
        lines += [f"name#{k}={name}", f"category#{k}={category}", f"model#{k}=/box/box.obj"]
        lines += [f"{key}#{k}={value}" for key, value in keys]
        lines += [MORE[name].format(k)] if name in MORE else []
    with zipfile.ZipFile(folder / "some.sh3f", "w") as files:
        files.writestr("PluginFurnitureCatalog.properties", "\n".join(lines))
        files.writestr("box/box.obj", BOX)
        files.writestr("bare/bare.obj", BOX)
        files.writestr("box/box.mtl", "newmtl red\nKd 1 0 0\nnewmtl other\n")
    return folder
