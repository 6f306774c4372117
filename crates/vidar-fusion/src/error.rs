//! Errors of fusion.

use thiserror::Error;
use vidar_core::{ChunkId, FrameId};

/// Why a volume cannot be created or a view cannot be fused. A rejected view leaves the volume unchanged.
#[derive(Clone, Debug, PartialEq, Error)]
#[non_exhaustive]
pub enum FusionError {
    /// A setting is outside its range.
    #[error("fusion.{field} must be {min} to {max}, found {found}")]
    BadConfig {
        /// Which field.
        field: &'static str,
        /// Smallest value allowed.
        min: f64,
        /// Largest value allowed.
        max: f64,
        /// The value.
        found: f64,
    },
    /// The camera is so far from the origin that single precision does not resolve the voxels.
    #[error(
        "frame {frame}: camera is {distance_m:.0} m from the origin, but voxels of {voxel_size_m} m reach \
         {limit_m:.0} m; move the world's origin or use larger voxels"
    )]
    TooFar {
        /// Which view.
        frame: FrameId,
        /// Distance of the camera from the world's origin, metres.
        distance_m: f64,
        /// Voxel edge, metres.
        voxel_size_m: f64,
        /// Distance that this voxel size reaches, metres.
        limit_m: f64,
    },
    /// Voxels are so much finer than the pixels that the surface would have holes.
    #[error(
        "frame {frame}: voxels of {voxel_size_m} m are far finer than the {footprint_m:.4} m between \
         neighbouring pixels at the median depth; use voxels of at least {smallest_m:.4} m"
    )]
    VoxelTooSmall {
        /// Which view.
        frame: FrameId,
        /// Voxel edge, metres.
        voxel_size_m: f64,
        /// Distance between neighbouring pixels at the view's median depth, metres.
        footprint_m: f64,
        /// Smallest voxel edge that this view allows, metres.
        smallest_m: f64,
    },
    /// The texture would be larger or smaller than is made.
    #[error("a texture must have {min} to {max} texels along its longer edge, found {found}")]
    BadTextureSize {
        /// Smallest value allowed.
        min: usize,
        /// Largest value allowed.
        max: usize,
        /// The value.
        found: usize,
    },
    /// A mesh whose lists do not fit each other.
    #[error("a mesh has triangles or attributes that do not fit its {vertices} vertices")]
    BadMesh {
        /// Vertices of the mesh.
        vertices: usize,
    },
    /// An image that is not that of its camera.
    #[error("view {view}: the image has {}x{} pixels, its camera {}x{}", found.0, found.1, expected.0, expected.1)]
    ImageSize {
        /// Which of the views, counted from 0.
        view: usize,
        /// Width and height of the image.
        found: (usize, usize),
        /// Width and height of its camera.
        expected: (usize, usize),
    },
    /// The accumulators hold no more views without overflow.
    #[error("frame {frame}: the volume already holds {limit} views, the limit of its sums")]
    TooManyViews {
        /// Which view.
        frame: FrameId,
        /// The limit.
        limit: u32,
    },
    /// A keyframe that a chunk has fused already: each is fused once, by its owner.
    #[error("frame {frame} was fused by chunk {owner} already, chunk {chunk} cannot fuse it again")]
    FusedAlready {
        /// Which view.
        frame: FrameId,
        /// The chunk that fused it.
        owner: ChunkId,
        /// The chunk that should fuse it now.
        chunk: ChunkId,
    },
    /// No view of that chunk was fused.
    #[error("chunk {chunk} holds no views")]
    NoSuchChunk {
        /// Which chunk.
        chunk: ChunkId,
    },
    /// A keyframe of another chunk, or of none.
    #[error("frame {frame} was not fused by chunk {chunk}")]
    NotOfChunk {
        /// Which view.
        frame: FrameId,
        /// The chunk whose revision names it.
        chunk: ChunkId,
    },
    /// A revised pose or scale is not finite, or the scale not positive.
    #[error(
        "frame {frame} of chunk {chunk}: its revised pose is not finite, or its depth factor is not finite and positive"
    )]
    BadMove {
        /// Which view.
        frame: FrameId,
        /// Its chunk.
        chunk: ChunkId,
    },
    /// A chunk's volume is not in memory.
    #[error("chunk {chunk} is offloaded")]
    Offloaded {
        /// Which chunk.
        chunk: ChunkId,
    },
    /// Bytes that are not those of an offloaded volume.
    #[error("an offloaded volume is corrupt at byte {at}: expected {what}")]
    BadSnapshot {
        /// What was expected.
        what: &'static str,
        /// Where, bytes from the beginning.
        at: u64,
    },
}
