//! The tests of the core that use what it shows to others. They are one program, as each links the whole core.
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
mod street;
