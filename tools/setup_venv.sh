#!/bin/sh
# Makes .venv with the package in it (editable, with what its commands and tests need): tools/setup_venv.sh PYTHON
set -eu
python=$1

"$python" -c 'import sys; sys.exit(sys.version_info < (3, 10))' || {
    echo "$python does not run, or is older than Python 3.10: name another with \`make setup PYTHON=...\`" >&2
    exit 2
}

can() { "$python" -c "import $1" 2>/dev/null; }

if ! .venv/bin/python -m pip --version >/dev/null 2>&1; then
    if ! can ensurepip && ! can pip; then  # Debian keeps both in packages of their own
        package=python$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')-venv
        if [ "$(id -u)" != 0 ] || ! command -v apt-get >/dev/null; then
            echo "$python cannot make virtual environments: run \`apt-get install $package\` as root" \
                 "or name another with \`make setup PYTHON=...\`" >&2
            exit 2
        fi
        echo "installing $package ..."
        apt-get -qq update >/dev/null
        DEBIAN_FRONTEND=noninteractive apt-get -qq install --yes --no-install-recommends "$package" >/dev/null
    fi
    echo "making .venv ..."
    if can ensurepip; then
        "$python" -m venv --clear .venv
    else
        "$python" -m venv --clear --without-pip .venv
        "$python" -m pip --python .venv/bin/python install --quiet --disable-pip-version-check pip
    fi
fi
echo "installing pp-cl and what it needs into .venv ..."
PYTHONWARNINGS=ignore .venv/bin/python -m pip install --quiet --disable-pip-version-check --editable '.[test,lint,video,view]'
