//! Independent f64 oracles.
