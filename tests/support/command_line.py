"""Commands of fgloc, run in this process."""

from typer.testing import CliRunner

from fgloc import cli


def fgloc(*arguments):
    """Exit code, stdout and stderr of one command; an exception that leaves it fails the test."""
    done = CliRunner().invoke(cli.app, [str(a) for a in arguments])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return done.exit_code, done.stdout, done.stderr
