//! One weight tensor: a view into a mapped checkpoint, or owned values.

use std::ops::Range;
use std::sync::Arc;

use crate::checkpoint::header::Dtype;
use crate::kernels::map::Mapping;

/// A weight tensor, row-major. Cloning is cheap: the storage is shared.
///
/// Kernels decode and pack the panels they need while they run (about 1/rows of the work), so that a checkpoint is never
/// held twice.
#[derive(Debug, Clone)]
pub struct Weight {
    name: Arc<str>,
    shape: Arc<[usize]>,
    storage: Storage,
}

#[derive(Debug, Clone)]
enum Storage {
    Mapped { dtype: Dtype, bytes: Arc<Mapping>, range: Range<usize> },
    Owned(Arc<[f32]>),
}

impl Weight {
    /// A weight that owns its values.
    ///
    /// # Panics
    /// When the number of values is not the product of the shape.
    pub fn owned(name: &str, shape: &[usize], values: Vec<f32>) -> Self {
        assert_eq!(
            values.len(),
            shape.iter().product::<usize>(),
            "{name}: values do not fill shape {shape:?}"
        );
        Self { name: name.into(), shape: shape.into(), storage: Storage::Owned(values.into()) }
    }

    /// A view into a mapping; the caller has checked that `range` holds `shape` elements of a floating `dtype`.
    pub(crate) fn mapped(
        name: &str,
        shape: &[usize],
        dtype: Dtype,
        bytes: Arc<Mapping>,
        range: Range<usize>,
    ) -> Self {
        debug_assert_eq!(range.len(), shape.iter().product::<usize>() * dtype.size());
        Self { name: name.into(), shape: shape.into(), storage: Storage::Mapped { dtype, bytes, range } }
    }

    /// The key under which it was found.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Its shape, outermost first.
    pub fn shape(&self) -> &[usize] {
        &self.shape
    }

    /// Number of elements.
    pub fn len(&self) -> usize {
        self.shape.iter().product()
    }

    /// Whether it has no element.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The number format it is stored in.
    pub fn dtype(&self) -> Dtype {
        match &self.storage {
            Storage::Mapped { dtype, .. } => *dtype,
            Storage::Owned(_) => Dtype::F32,
        }
    }

    /// All values, decoded.
    pub fn to_f32(&self) -> Vec<f32> {
        let mut values = vec![0.0; self.len()];
        self.read(0, &mut values);
        values
    }

    /// Decodes `out.len()` values from flat index `start` on.
    pub(crate) fn read(&self, start: usize, out: &mut [f32]) {
        match &self.storage {
            Storage::Owned(values) => out.copy_from_slice(&values[start..start + out.len()]),
            Storage::Mapped { dtype, bytes, range } => {
                let from = range.start + start * dtype.size();
                let to = from + out.len() * dtype.size();
                debug_assert!(to <= range.end);
                let decoded = dtype.read_f32(&bytes.bytes()[from..to], out);
                debug_assert!(decoded, "{}: {dtype} is no floating format", self.name);
            }
        }
    }
}
