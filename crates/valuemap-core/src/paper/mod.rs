//! The paper's method: Algorithm 1 of Dabisias, Ruffaldi, Grimmett and Ondruska, "VALUE: Large Scale Voting-based Automatic
//! Labelling for Urban Environments", ICRA 2018, in the order of the modules:
//!
//! 1. [`partition`]: images are split into clusters that are worked on alone and in parallel.
//! 2. [`hypothesis`]: in a cluster, every pair of rays of different images proposes a 3D point by
//!    [`two_view`] triangulation; pairs that see nothing together are dropped by reason.
//! 3. [`ballot`]: every hypothesis is projected into every image; the closest detection votes. The
//!    [`kernel`](crate::kernel) tests a few thousand million projections a second; each candidate it finds is tested exactly.
//! 4. [`select`]: the hypothesis with most votes wins, its voters leave, and so on until support is too thin.
//! 5. [`triangulate`] refines each winner over all its voters.
//! 6. [`merge`]: labels of different clusters that stand for one object become one.
//!
//! [`vote`] is steps 2 to 5 for all clusters.

pub mod ballot;
pub mod hypothesis;
pub mod merge;
pub mod partition;
pub mod select;
pub mod triangulate;
pub mod two_view;
pub mod vote;
