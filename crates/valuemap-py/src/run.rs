//! Long work on its own threads, while Python's thread reports progress and listens for Ctrl-C.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::Duration;

use pyo3::exceptions::{PyKeyboardInterrupt, PyMemoryError, PyRuntimeError};
use pyo3::prelude::*;
use valuemap_core::progress::{Halt, Progress};

const POLL: Duration = Duration::from_millis(50);

/// Run `job` on `threads` threads (0: one a core), calling `report(done, total)` now and then.
///
/// A signal handler or a report that raises cancels the job; its exception is what the caller gets.
pub fn with_progress<T: Send>(
    py: Python<'_>,
    threads: usize,
    total: usize,
    report: &Bound<'_, PyAny>,
    job: impl FnOnce(&Progress) -> Result<T, Halt> + Send,
) -> PyResult<T> {
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .map_err(|error| PyRuntimeError::new_err(error.to_string()))?;
    let progress = Progress::default();
    let (sender, mut receiver) = channel();
    let result = std::thread::scope(|scope| {
        let progress = &progress;
        scope.spawn(move || {
            let done = catch_unwind(AssertUnwindSafe(|| pool.install(|| job(progress))));
            // The receiver only goes away after this thread has sent.
            let _ = sender.send(done.map_err(|panic| said_by(panic.as_ref())));
        });
        let mut raised = None;
        loop {
            let waited;
            (waited, receiver) = py.detach(move || (receiver.recv_timeout(POLL), receiver));
            match waited {
                Ok(Ok(result)) => break raised.map_or(Ok(result), Err),
                Ok(Err(said)) => break Err(PyRuntimeError::new_err(format!("a fault in the numeric core: {said}"))),
                Err(RecvTimeoutError::Timeout) => {
                    let heard = py.check_signals().and_then(|()| report.call1((progress.done(), total)).map(drop));
                    if let Err(error) = heard {
                        progress.cancel();
                        raised.get_or_insert(error);
                    }
                }
                Err(RecvTimeoutError::Disconnected) => {
                    break Err(PyRuntimeError::new_err("the numeric core stopped unexpectedly"));
                }
            }
        }
    });
    result?.map_err(|halt| match halt {
        Halt::Cancelled => PyKeyboardInterrupt::new_err(()),
        Halt::TooLarge { rays, hypotheses } => PyMemoryError::new_err((rays, hypotheses)),
    })
}

/// What a panic said.
fn said_by(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().map(|said| (*said).to_owned());
    text.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap_or_else(|| "unknown".to_owned())
}
