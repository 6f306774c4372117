//! A part of the network that is built once, or each time it runs.

use crate::error::Da3Error;
use std::sync::Arc;

/// Whether the parts of a network stay in memory between runs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Residency {
    /// Built when the model is opened. Views into a mapped file cost nothing; synthetic weights stay in memory.
    #[default]
    Kept,
    /// Built when it runs and dropped afterwards: a network with synthetic weights then needs the memory of one block.
    OnDemand,
}

type Build<T> = Box<dyn Fn() -> Result<T, Da3Error> + Send + Sync>;

/// A part that is kept or built on demand.
pub(crate) struct Slot<T> {
    kept: Option<Arc<T>>,
    build: Build<T>,
}

impl<T> Slot<T> {
    pub fn new(
        residency: Residency,
        build: impl Fn() -> Result<T, Da3Error> + Send + Sync + 'static,
    ) -> Result<Self, Da3Error> {
        let kept = match residency {
            Residency::Kept => Some(Arc::new(build()?)),
            Residency::OnDemand => None,
        };
        Ok(Self { kept, build: Box::new(build) })
    }

    pub fn get(&self) -> Result<Arc<T>, Da3Error> {
        match &self.kept {
            Some(part) => Ok(Arc::clone(part)),
            None => Ok(Arc::new((self.build)()?)),
        }
    }
}
