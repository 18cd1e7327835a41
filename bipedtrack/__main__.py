"""`bipedtrack`: the list of commands; `bipedtrack --version`: the versions of package and stack."""

import argparse

from bipedtrack import __version__, versions

COMMANDS = {
    "train": "train a policy through the stages of a curriculum",
    "export": "write the policy of a training run to one file that numpy alone can run",
    "simulate": "drive the robot through a footstep script in MuJoCo C",
    "teleop": "drive the robot by node targets that come over UDP",
    "curves": "draw the learning curves of training runs side by side",
    "evaluate": "measure the tracking error of every step, on two simulators",
    "play": "drive the robot in a browser",
    "video": "film a policy at a task or on a footstep script",
    "doctor": "check versions, devices, rendering and the physics of this machine",
}


def main() -> None:
    """Prints the commands or the versions; leaves with status 2 on any other argument."""
    parser = argparse.ArgumentParser(
        prog="bipedtrack",
        description="commands, each with a --help of its own:\n"
        + "\n".join(f"  python -m bipedtrack.{name:<9}{purpose}" for name, purpose in COMMANDS.items()),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--version",
        action="version",
        version=f"bipedtrack {__version__}\n{versions.table(versions.check())}",
        help="print the versions of bipedtrack and of its stack",
    )
    parser.parse_args()
    parser.print_help()


if __name__ == "__main__":
    main()
