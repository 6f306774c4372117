//! How a sequence of keyframes is cut into chunks.

use crate::AlignError;
use std::ops::Range;

/// A chunk as ranges of keyframe indices.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ChunkSpan {
    /// Keyframes that this chunk owns: over all chunks each keyframe once.
    pub core: Range<usize>,
    /// Keyframes that the geometry model sees; contains `core`.
    pub seen: Range<usize>,
}

/// Chunks of `size` keyframes of which neighbours share `overlap`: chunk k sees
/// `[k (size − overlap), k (size − overlap) + size)`. What two chunks share is divided between them by [`divide_overlaps`].
///
/// # Errors
/// [`AlignError::BadChunking`] unless `overlap < size`.
pub fn overlapping_chunks(
    keyframes: usize,
    size: usize,
    overlap: usize,
) -> Result<Vec<ChunkSpan>, AlignError> {
    if overlap >= size {
        return Err(AlignError::BadChunking { size, overlap });
    }
    if keyframes == 0 {
        return Ok(Vec::new());
    }
    let step = size - overlap;
    let count = if keyframes <= size { 1 } else { (keyframes - overlap).div_ceil(step) };
    let seen = (0..count).map(|k| k * step..(k * step + size).min(keyframes)).collect();
    Ok(divide_overlaps(seen))
}

/// Chunks of `size` keyframes that own disjoint ranges and see up to `context` further keyframes on each side: for models
/// whose poses are given (stereo), so that no overlap is needed to connect chunks.
pub fn chunks_with_context(keyframes: usize, size: usize, context: usize) -> Vec<ChunkSpan> {
    (0..keyframes)
        .step_by(size.max(1))
        .map(|start| {
            let end = (start + size.max(1)).min(keyframes);
            ChunkSpan {
                core: start..end,
                seen: start.saturating_sub(context)..(end + context).min(keyframes),
            }
        })
        .collect()
}

/// Assigns every keyframe to one of the chunks that see it. What two neighbours share is halved between them, because
/// predicted geometry is worst at the ends of a chunk. `seen` ranges are in ascending order.
pub fn divide_overlaps(seen: Vec<Range<usize>>) -> Vec<ChunkSpan> {
    let boundary = |a: &Range<usize>, b: &Range<usize>| b.start + a.end.saturating_sub(b.start) / 2;
    let core = |k: usize| {
        let start = if k == 0 { seen[0].start } else { boundary(&seen[k - 1], &seen[k]) };
        let end = seen.get(k + 1).map_or(seen[k].end, |next| boundary(&seen[k], next));
        start..end.max(start)
    };
    (0..seen.len()).map(|k| ChunkSpan { core: core(k), seen: seen[k].clone() }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::streaming::chunk_ranges;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn every_keyframe_has_one_owner_that_sees_it(n in 0usize..500, size in 1usize..60, overlap in 0usize..59) {
            prop_assume!(overlap < size);
            let chunks = overlapping_chunks(n, size, overlap).unwrap();
            let owned: Vec<usize> = chunks.iter().flat_map(|c| c.core.clone()).collect();
            prop_assert_eq!(owned, (0..n).collect::<Vec<_>>());
            prop_assert!(chunks.iter().all(|c| c.seen.start <= c.core.start && c.core.end <= c.seen.end));
            let reference: Vec<_> = chunk_ranges(n, size, overlap).unwrap().into_iter().map(|r| r.frames).collect();
            prop_assert_eq!(chunks.into_iter().map(|c| c.seen).collect::<Vec<_>>(), reference);
        }
    }

    #[test]
    fn shared_keyframes_are_halved() {
        let chunks = overlapping_chunks(37, 16, 4).unwrap();
        assert_eq!(chunks[0], ChunkSpan { core: 0..14, seen: 0..16 });
        assert_eq!(chunks[1], ChunkSpan { core: 14..26, seen: 12..28 });
        assert_eq!(chunks[2], ChunkSpan { core: 26..37, seen: 24..37 });
        assert_eq!(overlapping_chunks(3, 16, 4).unwrap(), [ChunkSpan { core: 0..3, seen: 0..3 }]);
    }

    #[test]
    fn an_overlap_as_long_as_the_chunk_is_an_error() {
        let error = overlapping_chunks(10, 4, 4).unwrap_err();
        assert!(error.to_string().contains("cannot overlap by 4"), "{error}");
    }

    #[test]
    fn context_is_seen_on_both_sides_and_not_owned() {
        let chunks = chunks_with_context(37, 16, 4);
        assert_eq!(chunks.iter().map(|c| c.core.len()).sum::<usize>(), 37);
        assert_eq!(chunks[0], ChunkSpan { core: 0..16, seen: 0..20 });
        assert_eq!(chunks[1], ChunkSpan { core: 16..32, seen: 12..36 });
        assert_eq!(chunks[2], ChunkSpan { core: 32..37, seen: 28..37 });
        assert!(chunks_with_context(0, 16, 4).is_empty());
    }
}
