"""What progress was told: of each kind of work that it begins with a total and ends with the work."""

from __future__ import annotations


class Told:
    """A progress that remembers all it hears."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, int, int]] = []

    def __call__(self, what: str, done: int, total: int) -> None:
        self.calls.append((what, done, total))

    def check(self, *kinds: str) -> None:
        """Check each kind of work, among which are these: from 0 of a total, which stays, never back, to all of it."""
        heard: dict[str, tuple[int, int]] = {}
        for what, done, total in self.calls:
            assert total > 0, f"{what} has no total"
            before, known = heard.get(what, (total, total))
            if done == 0 and before == known:  # It begins, for the first time or once more.
                before, known = 0, total
            assert what in heard or done == 0, f"{what} begins with {done}"
            assert total == known, f"the total of {what} changes from {known} to {total}"
            assert before <= done <= total, f"{what} goes from {before} to {done} of {total}"
            heard[what] = (done, total)
        for what, (done, total) in heard.items():
            assert done == total, f"{what} ends with {done} of {total}"
        assert set(kinds) <= set(heard), f"heard of {sorted(heard)}"
