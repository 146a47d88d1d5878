//! How long work tells its caller that it goes on, and is told to stop.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

/// Counter of finished units of work, and the caller's wish to stop.
#[derive(Debug, Default)]
pub struct Progress {
    done: AtomicUsize,
    cancelled: AtomicBool,
}

/// Why work ended without a result.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Halt {
    /// The caller asked to stop.
    Cancelled,
    /// A cluster has so many hypotheses that their votes would not fit into memory.
    TooLarge {
        /// Rays of the cluster.
        rays: usize,
        /// Its viable pairs.
        hypotheses: usize,
    },
}

impl Progress {
    /// Report one unit as finished, or learn that the work is to stop.
    ///
    /// # Errors
    /// [`Halt::Cancelled`] once [`Progress::cancel`] was called.
    pub fn advance(&self) -> Result<(), Halt> {
        self.done.fetch_add(1, Ordering::Relaxed);
        self.check()
    }

    /// Learn whether the work is to stop.
    ///
    /// # Errors
    /// [`Halt::Cancelled`] once [`Progress::cancel`] was called.
    pub fn check(&self) -> Result<(), Halt> {
        if self.cancelled.load(Ordering::Relaxed) { Err(Halt::Cancelled) } else { Ok(()) }
    }

    /// Units finished so far.
    pub fn done(&self) -> usize {
        self.done.load(Ordering::Relaxed)
    }

    /// Ask the work to stop at its next unit.
    pub fn cancel(&self) {
        self.cancelled.store(true, Ordering::Relaxed);
    }
}
