#!/usr/bin/env bash
# Create .venv and install the lock: no root, nothing global, never a CUDA torch on a machine without a GPU.
set -euo pipefail
cd "$(dirname "$0")/.."

python=""
for candidate in python3.11 python3; do
  if "$candidate" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' 2>/dev/null; then python=$candidate; break; fi
done
[ -n "$python" ] || { echo "setup: Python 3.11 is needed (python3.11 or python3 on PATH); the lock is resolved for it" >&2; exit 2; }

# Programs in .venv begin with its path: one that was made elsewhere (a renamed or copied clone) runs nothing here.
made=$(sed -n 's|^command = .* -m venv [^/]*/|/|p' .venv/pyvenv.cfg 2>/dev/null || true)
if [ -n "$made" ] && [ "$made" != "$(realpath .venv)" ]; then
  echo "setup: .venv was made for $made; making it anew" >&2
  rm -rf .venv
fi
[ -x .venv/bin/python ] || "$python" -m venv .venv
py=.venv/bin/python
$py -m pip install --quiet "uv==0.13.8"

# uv does not read pip's configuration: hand over its find-links. Without a CPU torch there, uv picks the build
# that fits the machine (`--torch-backend auto`: CPU where there is no NVIDIA GPU).
links=$($py -m pip config get global.find-links 2>/dev/null || true)
options=(--torch-backend auto)
for folder in $links; do
  options=("${options[@]}" --find-links "$folder")
  if compgen -G "$folder/torch-2.13.0*" >/dev/null; then options=(--find-links "$folder"); break; fi
done
$py -m uv pip install --quiet --python $py -r requirements.lock "${options[@]}"
$py -m uv pip install --quiet --python $py --no-deps --editable .

# open3d wants libusb-1.0.so.0; libusb-package ships it, and a link beside libOpen3D lets the loader find it.
site=$($py -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
ln -sfn ../libusb_package/libusb-1.0.so "$site/open3d/libusb-1.0.so.0"

if [ ! -e /proc/driver/nvidia/version ]; then
  $py -c 'import sys, torch; sys.exit(f"setup: a CUDA torch ({torch.__version__}) on a machine without a GPU" if torch.version.cuda else 0)'
fi
echo "setup: ready ($($py --version))" >&2
