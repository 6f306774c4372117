//! The same functions for a program without Zenoh: nothing can be opened.

use super::{Delivery, LinkOptions, Role, Sample, Serving};
use crate::error::LinkError;
use crate::geometry::{Reach, Served};
use std::sync::Arc;
use std::time::Duration;

/// A session; there is none.
pub enum Link {}
/// A publisher; there is none.
pub enum Publisher {}
/// A subscription; there is none.
pub enum Subscription {}

impl Link {
    /// Says that the program cannot.
    ///
    /// # Errors
    /// Always [`LinkError::NotBuilt`].
    pub fn open(_: &LinkOptions, _: Role) -> Result<Self, LinkError> {
        Err(LinkError::NotBuilt)
    }

    /// See the feature `zenoh`.
    ///
    /// # Errors
    /// None: there is no session.
    pub fn reach(self, _: &str) -> Result<Box<dyn Reach>, LinkError> {
        match self {}
    }

    /// See the feature `zenoh`.
    ///
    /// # Errors
    /// None: there is no session.
    pub fn serve(
        &self,
        _: &str,
        _: &str,
        _: Arc<dyn Served>,
        _: &dyn Fn(Serving),
        _: &(dyn Fn() -> bool + Sync),
    ) -> Result<(), LinkError> {
        match *self {}
    }

    /// See the feature `zenoh`.
    ///
    /// # Errors
    /// None: there is no session.
    pub fn subscribe(&self, _: &str) -> Result<Subscription, LinkError> {
        match *self {}
    }

    /// See the feature `zenoh`.
    ///
    /// # Errors
    /// None: there is no session.
    pub fn publisher(&self, _: &str, _: Option<&str>, _: Delivery) -> Result<Publisher, LinkError> {
        match *self {}
    }

    /// See the feature `zenoh`.
    pub fn id(&self) -> [u8; 16] {
        match *self {}
    }
}

impl Publisher {
    /// See the feature `zenoh`.
    ///
    /// # Errors
    /// None: there is no publisher.
    pub fn put(&self, _: Vec<u8>, _: Vec<u8>) -> Result<(), LinkError> {
        match *self {}
    }
}

impl Subscription {
    /// See the feature `zenoh`.
    pub fn next(&self, _: Duration) -> Option<Sample> {
        match *self {}
    }

    /// See the feature `zenoh`.
    pub fn dropped(&self) -> u64 {
        match *self {}
    }
}
