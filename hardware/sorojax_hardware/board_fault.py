"""The error of a board that does not follow, and what it says."""

from sorojax_board.frames import Kind
from sorojax_board.messages import Refusal, Report, State


class BoardFault(RuntimeError):
    """The board does not follow; `report` is what it said last."""

    def __init__(self, message: str, report: Report | None = None):
        super().__init__(message)
        self.report = report


def explained(kind: Kind, why: Refusal, report: Report) -> str:
    """What was refused, why, and what to do about it."""
    text = f"TcpBoard: the board refused {kind.name}: {why.name.lower().replace('_', ' ')}."
    if why is Refusal.NOT_ARMED and report.state is State.FAULT:
        fault = str(report.fault.name).lower().replace("_", " ")
        text += f" It vented after a fault: {fault}. Look for the cause, then arm()."
    elif why is Refusal.NOT_ARMED:
        text += " Call arm() first."
    elif why is Refusal.NOT_WRITER:
        text += " Another client writes, or this one is read-only."
    return text
