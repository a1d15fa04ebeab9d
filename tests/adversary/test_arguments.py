"""Odd values of arguments are accepted or refused in words; what is accepted has a meaning."""

from arguments import fuzz, leaks


def test_arguments_are_accepted_or_refused_in_words(tmp_path, monkeypatch):
    """And what a designer mistypes does not pass for a number."""
    monkeypatch.chdir(tmp_path)
    outcomes = fuzz()
    assert len(outcomes) > 7_000
    assert leaks(outcomes) == {}
    of_numbers = {  # arguments that take numbers and neither texts nor truth values
        "plant": ("m", "delay"), "plant limit": ("limit",), "lqr": ("rate", "Q", "R"), "close_many case": ("m",),
        "run.at": ("t",), "structure": ("motion",), "paths.rest_to_rest": ("start", "duration", "t_start"),
        "sampled_bound": ("rho", "delay"), "Poles": ("values",), "Timing": ("rate", "delay"), "slowed": ("factor",),
        "start": ("t", "y"), "simulate": ("t_span", "accuracy"), "particle": ("mass",), "parameters": ("m",),
        "disturbances.step": ("size", "at"), "Program residual": ("residual",), "interop.linearise": ("t", "rate"),
    }  # fmt: skip
    for name, arguments in of_numbers.items():
        for argument in arguments:
            for odd in "a number in text/True/bytes/array of text/1j/complex64/complex array/NaN/function".split("/"):
                assert outcomes[name, argument, odd] == "refused", (name, argument, odd)
