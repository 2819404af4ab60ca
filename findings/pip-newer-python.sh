#!/usr/bin/env bash
# Guess: pip tells whoever installs a package that needs a newer Python just that. Up to 25.0 it
# compares the package's dependencies first, and they have no version for the old Python either. So
# the message is of a conflict between two lines that agree, or of a version that does not exist.
# Found with pip 22.0.2 of Ubuntu 22.04, whose Python is 3.10: "evercal 0.2.0 depends on
# scipy>=1.17.0. The user requested (constraint) scipy==1.17.1". Here with a Python that is to come
# and pip 24.0 and 26.3; the latter names Python.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
mkdir "$folder/needs_newer"
cat > "$folder/needs_newer/pyproject.toml" <<'TOML'
[build-system]
requires = ["hatchling==1.27.0"]
build-backend = "hatchling.build"

[project]
name = "needs-newer"
version = "1"
requires-python = ">=3.99"
dependencies = ["six>=99"]

[tool.hatch.build.targets.wheel]
bypass-selection = true
TOML
echo "six==99.1" > "$folder/constraints.txt"
for version in 24.0 26.3; do
    python3 -m venv --clear "$folder/venv"
    "$folder/venv/bin/pip" install --quiet "pip==$version"
    "$folder/venv/bin/pip" --version | cut -d' ' -f1,2
    ! "$folder/venv/bin/pip" install -c "$folder/constraints.txt" "$folder/needs_newer" \
        > "$folder/$version" 2>&1
    grep -E "depends on|requested|different Python" "$folder/$version" | sed 's/^/  /'
done
grep -q "The user requested (constraint) six==99.1" "$folder/24.0"
! grep -q "requires a different Python" "$folder/24.0"
grep -q "requires a different Python: .* not in '>=3.99'" "$folder/26.3"
echo "as described"
