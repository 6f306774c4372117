//! What can go wrong in fusion.

use thiserror::Error;
use vidar_core::{ChunkId, FrameId};

/// Why a volume cannot be made, or a view not be fused. A refused view leaves the volume as it was.
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
    /// The camera stands so far from the origin that single precision cannot carry the map.
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
    /// Voxels are so much finer than the pixels that no surface would close.
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
    /// The accumulators hold no more views without overflow.
    #[error("frame {frame}: the volume already holds {limit} views, the most its sums can carry")]
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
        /// The chunk that was to fuse it now.
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
        /// The chunk that was told to move it.
        chunk: ChunkId,
    },
    /// A revised pose or scale is not finite, or the scale not positive.
    #[error(
        "frame {frame} of chunk {chunk} cannot move there: its pose or its depth factor is not finite and positive"
    )]
    BadMove {
        /// Which view.
        frame: FrameId,
        /// Its chunk.
        chunk: ChunkId,
    },
    /// A chunk's volume waits elsewhere.
    #[error("chunk {chunk} was set aside; bring it back first")]
    SetAside {
        /// Which chunk.
        chunk: ChunkId,
    },
    /// Bytes that are not those of a volume that was set aside.
    #[error("a volume that was set aside is broken at byte {at}: expected {what}")]
    BadSnapshot {
        /// What was expected.
        what: &'static str,
        /// Where, bytes from the beginning.
        at: u64,
    },
}
