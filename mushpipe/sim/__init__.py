"""The simulated mushroom bed and the sensor model behind the source `synthetic`.

Geometry is a triangle mesh, ray cast, so depth, labels and normals are exact; colour is painted
on it by procedural textures and lit by a few lamps. Lengths are metres. The *bed frame* has z up,
z = 0 on the bed, x to the right and y to the top of the image of a camera that looks straight
down; truth and depth are given in the camera's optical frame (x right, y down, z forward).

Order of the modules: `settings`, `noise`, `mesh`, `shapes`, `mushroom`, `planting`, `ground`,
`table`, `raycast`, `world`, `render`, `material`, `light`, then `photo`, `sensor`, `annotate`, and
with all of them `scene`; `recordings` makes the files that the project carries.
"""
