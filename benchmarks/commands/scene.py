"""`python -m benchmarks scene`: the pictures of a scene of the suite, for other software."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from benchmarks.console import one_sentence


def scene(
    name: Annotated[str, typer.Argument(help="A scene of the suite.")],
    out: Annotated[Path, typer.Option(help="New folder for the tilt series.")],
    quick: Annotated[bool, typer.Option("--quick", help="Smaller images, as with run --quick.")] = False,
    development: Annotated[
        bool, typer.Option("--development", help="Specimen and noise for tuning, not those that are reported.")
    ] = False,
    repetition: Annotated[int, typer.Option(min=0, help="Which noise; the surface stays.")] = 0,
    truth: Annotated[bool, typer.Option("--truth", help="Write truth/ too; methods never read it.")] = False,
    cache: Annotated[Path, typer.Option(help="Folder where rendered surfaces are kept.")] = Path("results/run/cache"),
) -> None:
    """Write the very pictures that methods are given of a scene, as a tilt series folder without truth."""
    with one_sentence():
        import numpy as np

        from benchmarks.running.runner import seed_of
        from benchmarks.suite import Purpose, chosen, described, suite
        from semrecon.folder import check_target
        from semrecon.input.series import write_series
        from semsim.capture import expose
        from semsim.io import write_series as write_with_truth

        check_target(out, lambda _: False)
        purpose: Purpose = "development" if development else "reporting"
        (picked,) = chosen(suite(cache, quick=quick, purpose=purpose), [name])
        if truth:
            seed = seed_of(picked.source.name, repetition)
            write_with_truth(expose(picked.source.surfaces(), np.random.default_rng(seed)), out, seed)
        else:
            write_series(picked.series(repetition), out)
    typer.echo(f"{out} holds {name}: {described(picked)}")
    typer.echo(
        f"Judge a reconstruction of it: python -m benchmarks score FILE --scene {name}"
        + " --quick" * quick
        + " --development" * development
    )
