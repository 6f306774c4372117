//! Tensors, checkpoint reading and CPU kernels: the only crate that knows how a network is computed.
