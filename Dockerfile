# Three images from one source (deploy/kubernetes uses the image `serve` with this tag):
#
#   docker build --target serve|train|collect -t driverview-TARGET:0.2.0 .
#   docker run -p 8000:8000 -e DRIVERVIEW_TOKEN -v "$PWD/runs:/driverview/runs:ro" \
#     driverview-serve:0.2.0 serve --model latest --host 0.0.0.0
#   docker run -v "$PWD/datasets:/driverview/datasets" \
#     driverview-collect:0.2.0 datagen collect --rounds 60
#   docker run --gpus all -v "$PWD/datasets:/driverview/datasets:ro" -v "$PWD/runs:/driverview/runs" \
#     driverview-train:0.2.0 mtlnet train --alpha 0.3,0.2,0.5
#
# The processes run as user 10001: folders they write to must let it (`chown 10001 runs datasets`).

# The base image is pinned by the digest of its index for all platforms, of September 2026, so that
# images are the same tomorrow. Renew it for security updates of Debian and Python:
#
#   docker buildx imagetools inspect python:3.11-slim
#   docker build --build-arg PYTHON_IMAGE=python:3.11-slim@sha256:...

ARG PYTHON_IMAGE=python:3.11-slim@sha256:9534e5a8e315485d4061ed659af0fd78a284c015f9b73661b41d6bab25604534
FROM ${PYTHON_IMAGE} AS wheel
WORKDIR /src
COPY pyproject.toml README.md LICENSE requirements.lock ./
COPY trackfeatures trackfeatures
COPY runtime runtime
COPY simulator simulator
COPY datagen datagen
COPY mtlnet mtlnet
COPY serve serve
COPY controllers controllers
# What builds the wheel is of a known hash, too: an isolated build would take the newest.
RUN sed -n '/^setuptools==/,/[^\\]$/p' requirements.lock > build.txt \
    && pip install --no-cache-dir --require-hashes --requirement build.txt \
    && pip wheel --no-cache-dir --no-deps --no-build-isolation --wheel-dir /wheels .

FROM ${PYTHON_IMAGE} AS base
ENV PYTHONUNBUFFERED=1 PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
RUN useradd --create-home --uid 10001 driverview && install -d -o driverview /driverview
# The lock pins the versions and the hashes of their files, which uv checks; which of them an image
# gets is for its extras to say. (pip takes no hashes from constraints for a wheel without one.)
COPY requirements.lock deploy/uv.txt /wheels/
RUN pip install --require-hashes --requirement /wheels/uv.txt
ENV UV_NO_CACHE=1 UV_SYSTEM_PYTHON=1
COPY --from=wheel /wheels /wheels
WORKDIR /driverview

# Physics and rendering; with no GPU, Mesa renders.
FROM base AS collect
RUN apt-get update \
    && apt-get install -y --no-install-recommends libegl1 libgl1 libgl1-mesa-dri \
    && rm -rf /var/lib/apt/lists/*
RUN uv pip install --constraint /wheels/requirements.lock "$(ls /wheels/*.whl)[simulation]"
USER driverview
CMD ["datagen", "collect", "--help"]

# torch, no physics.
FROM base AS train
RUN uv pip install --constraint /wheels/requirements.lock "$(ls /wheels/*.whl)[training]"
USER driverview
CMD ["mtlnet", "train", "--help"]

# Neither torch nor physics. Last, so that a plain `docker build .` makes it.
FROM base AS serve
RUN uv pip install --constraint /wheels/requirements.lock "$(ls /wheels/*.whl)"
USER driverview
EXPOSE 8000
HEALTHCHECK --interval=10s --timeout=5s --start-period=10s \
    CMD ["python", "-c", "import sys; from serve.client import Client; sys.exit(not Client().ready())"]
CMD ["serve", "--host", "0.0.0.0", "--port", "8000"]
