//! The tests of the core that are of no file alone. They are in one program with those of single files, so that the core is compiled once for all.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod against_brute_force;
mod hostile_input;
mod robust_calibration;
mod robust_candidates;
mod robust_confusions;
mod robust_drift;
mod robust_energy;
mod robust_labels;
mod robust_order;
mod robust_sides;
pub(crate) mod street;
