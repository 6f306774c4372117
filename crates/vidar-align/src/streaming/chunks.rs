//! Which frames form a chunk, and which chunk owns a frame (DA3-Streaming, sections 2 and 12 of its behaviour).

use super::StreamingError;
use std::ops::Range;

/// Frames of one chunk.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ChunkRange {
    /// Frames the model sees.
    pub frames: Range<usize>,
    /// Frames whose pose and depth are taken from this chunk: every frame has exactly one owner, and a frame of an
    /// overlap belongs to the later chunk.
    pub owned: Range<usize>,
}

/// Splits `frame_count` frames into chunks of `chunk_size` that share `overlap` frames with their predecessor.
///
/// With N ≤ C there is one chunk; else n = ⌈(N − O)/(C − O)⌉, chunk k = [k(C − O), min(k(C − O) + C, N)).
///
/// # Errors
/// [`StreamingError::BadChunking`] unless `overlap < chunk_size`.
pub fn chunk_ranges(
    frame_count: usize,
    chunk_size: usize,
    overlap: usize,
) -> Result<Vec<ChunkRange>, StreamingError> {
    if overlap >= chunk_size {
        return Err(StreamingError::BadChunking { chunk_size, overlap });
    }
    if frame_count == 0 {
        return Ok(Vec::new());
    }
    let step = chunk_size - overlap;
    let count = if frame_count <= chunk_size { 1 } else { (frame_count - overlap).div_ceil(step) };
    let range = |k: usize| {
        let frames = k * step..(k * step + chunk_size).min(frame_count);
        let end = if k + 1 == count { frames.end } else { frames.end - overlap };
        ChunkRange { owned: frames.start..end, frames }
    };
    Ok((0..count).map(range).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn every_frame_has_one_owner_and_every_overlap_is_complete(n in 0usize..2000, c in 1usize..150, o in 0usize..149) {
            prop_assume!(o < c);
            let chunks = chunk_ranges(n, c, o).unwrap();
            let owned: Vec<usize> = chunks.iter().flat_map(|k| k.owned.clone()).collect();
            prop_assert_eq!(owned, (0..n).collect::<Vec<_>>());
            for pair in chunks.windows(2) {
                prop_assert_eq!(pair[0].frames.end - pair[1].frames.start, o);
                prop_assert!(pair[1].frames.len() > o);
            }
            prop_assert!(chunks.iter().all(|k| k.frames.len() <= c));
        }
    }

    #[test]
    fn an_overlap_as_long_as_the_chunk_is_refused() {
        let error = chunk_ranges(10, 4, 4).unwrap_err();
        assert!(error.to_string().contains("cannot overlap by 4"), "{error}");
    }
}
