//! Preintegration and propagation against Runge-Kutta and numeric derivatives.
