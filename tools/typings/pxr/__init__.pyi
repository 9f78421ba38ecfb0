"""usd-core to the type checker: anything; its own stubs leave out what its modules take from their native halves."""

from typing import Any

def __getattr__(name: str) -> Any: ...
