"""What all solvers of a spline's normal equations have in common."""

from flexroad.tasks.errors import TaskError

RIDGE = 1e-9
"""Share of the diagonal's mean that is added to it: undetermined control points then keep their height."""


def undetermined(point: int) -> TaskError:
    """Return the error that says which control point, counted from 1, the equations do not determine."""
    return TaskError(
        f"control point {point} of the surface is undetermined; use fewer control points (a larger "
        "fit.spacing_m), or raise fit.bending_m3"
    )
