"""Fly a lap with a shipped policy, print its time, and draw it."""

import quadjax


def main():
    laps = quadjax.evaluate("e2e_fastest", "e2e +fastest", runs=1, laps=1, deterministic=True)
    print(laps.table())
    laps.plot().savefig("lap.png")


if __name__ == "__main__":
    main()
