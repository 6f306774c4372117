//! Nearest neighbours of points that move a little at a time, as those of an ICP do.
//!
//! A search finds the nearest point and how near another one can be. As long as the query has moved by less than the gap
//! between them allows, the nearest is still the same (triangle inequality) and no search is needed; a search that is needed starts from the
//! distance to the last one.

use super::tree::Found;
use super::{NOWHERE, NearestIndex, distance_m, usable};

/// Relative error of distances in the tree, with a margin: each takes fewer than eight roundings of 2⁻²⁴.
const ROUNDING: f64 = 1e-6;

/// What is known of the neighbours of a moving query.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Followed {
    /// Where it was when the index was searched.
    at: [f32; 3],
    /// Place of the nearest point.
    place: u32,
    /// Every other point was at least so far away from `at`.
    others_m: f32,
}

impl Followed {
    /// Nothing is known.
    pub(crate) const NEW: Self = Self { at: [0.0; 3], place: NOWHERE, others_m: 0.0 };
}

impl NearestIndex {
    /// Distance and position of the point nearest to `query`, a place of the query that `known` follows; `None` as in
    /// [`nearest`](Self::nearest).
    pub(crate) fn follow(&self, query: &[f32; 3], known: &mut Followed) -> Option<(f64, [f32; 3])> {
        let tree = self.tree.as_ref().filter(|_| usable(query))?;
        let mut start = Found { place: NOWHERE, squared: f32::INFINITY };
        if known.place != NOWHERE {
            let position = tree.position(known.place);
            let (distance, moved) = (distance_m(query, &position), distance_m(query, &known.at));
            if distance + moved < f64::from(known.others_m) * (1.0 - ROUNDING) {
                return Some((distance, position));
            }
            start = Found { place: known.place, squared: tree.squared_to(query, known.place) };
        }
        let (found, others) = tree.nearest_two(query, start);
        if found.place == NOWHERE {
            return None;
        }
        *known = Followed { at: *query, place: found.place, others_m: others.sqrt() };
        let position = tree.position(found.place);
        Some((distance_m(query, &position), position))
    }
}
