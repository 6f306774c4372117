"""The mesh of a run in Open3D: without files, with colours, cleaned up and written again.

    python with_open3d.py RUN OUTPUT.ply        # needs: pip install open3d
"""

import pathlib
import sys

import numpy as np
import open3d as o3d

import vidar


def for_open3d(mesh: vidar.Mesh) -> o3d.geometry.TriangleMesh:
    """The same mesh; Open3D's numbers are float64, its colours 0…1."""
    converted = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices.astype(np.float64)),
        o3d.utility.Vector3iVector(mesh.triangles.astype(np.int32)),
    )
    converted.vertex_normals = o3d.utility.Vector3dVector(mesh.normals.astype(np.float64))
    if mesh.colors is not None:
        converted.vertex_colors = o3d.utility.Vector3dVector(mesh.colors / 255.0)
    return converted


def main(run_folder: pathlib.Path, output: pathlib.Path) -> None:
    mesh = for_open3d(vidar.read_run(run_folder).mesh)
    print(f"{len(mesh.vertices)} vertices, {len(mesh.triangles)} triangles, {mesh.get_surface_area():.2f} m2")
    labels, counts, _ = mesh.cluster_connected_triangles()
    counts = np.asarray(counts)
    mesh.remove_triangles_by_mask(np.asarray(labels) != counts.argmax())
    mesh.remove_unreferenced_vertices()
    print(f"largest of {len(counts)} parts: {len(mesh.triangles)} triangles")
    o3d.io.write_triangle_mesh(str(output), mesh)


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2]))
