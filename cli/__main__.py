"""``python -m locatk.cli``."""

from locatk.cli.app import main

if __name__ == "__main__":
    main()
