//! Collects the intermediate results of a run that a reference file contains, views stacked and channels first.

use super::golden::Golden;
use crate::trace::{Layout, Trace, Traced};
use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};

/// Collected intermediate results.
pub(super) struct Collector {
    wanted: Vec<String>,
    views: usize,
    stacks: Mutex<BTreeMap<String, Stack>>,
}

/// One result of all views.
#[derive(Clone)]
pub(super) struct Stack {
    /// Shape of one view's part, channels first.
    pub shape: Vec<usize>,
    /// By view; empty where nothing was recorded.
    pub views: Vec<Vec<f32>>,
    /// Its position in the order of computation.
    pub order: usize,
}

impl Collector {
    pub fn new(golden: &Golden) -> Self {
        let wanted = golden.names().map(|name| without_thinning(name).0.to_owned()).collect();
        Self { wanted, views: golden.views, stacks: Mutex::new(BTreeMap::new()) }
    }

    pub fn take(&self, name: &str) -> Option<Stack> {
        self.stacks.lock().unwrap_or_else(PoisonError::into_inner).get(name).cloned()
    }
}

impl Trace for Collector {
    fn wants(&self, name: &str) -> bool {
        self.wanted.iter().any(|w| w == name)
    }

    fn record(&self, tensor: Traced<'_>) {
        let (shape, data) = match (tensor.layout, tensor.shape) {
            (Layout::Map, &[rows, columns, channels]) => {
                (vec![channels, rows, columns], channels_first(tensor.data, channels))
            }
            _ => (tensor.shape.to_vec(), tensor.data.to_vec()),
        };
        let mut stacks = self.stacks.lock().unwrap_or_else(PoisonError::into_inner);
        let order = stacks.len();
        let new = || Stack { shape, views: vec![Vec::new(); self.views], order };
        let stack = stacks.entry(tensor.name.to_owned()).or_insert_with(new);
        if let Some(view) = stack.views.get_mut(tensor.view) {
            *view = data;
        }
    }
}

fn channels_first(data: &[f32], channels: usize) -> Vec<f32> {
    (0..channels).flat_map(|c| data.iter().skip(c).step_by(channels.max(1)).copied()).collect()
}

/// How a tensor is subsampled in a reference.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Thinning {
    /// Not at all.
    None,
    /// Every N-th row and column of pixels.
    Pixels(usize),
    /// Every N-th token.
    Tokens(usize),
}

/// A tensor's name without the suffix of thinning, and the thinning.
pub(super) fn without_thinning(name: &str) -> (&str, Thinning) {
    let suffix = |mark: &str| {
        let (base, number) = name.rsplit_once(mark)?;
        number.parse().ok().filter(|n: &usize| *n > 0).map(|n| (base, n))
    };
    if let Some((base, n)) = suffix(".every") {
        return (base, Thinning::Tokens(n));
    }
    match suffix(".s") {
        Some((base, n)) => (base, Thinning::Pixels(n)),
        None => (name, Thinning::None),
    }
}
