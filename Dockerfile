# The command line on a CPU, in the folder that is mounted at /data:
#   docker build -t avatar .
#   docker run --rm --user "$(id -u)" -v "$PWD:/data" avatar create me.mp4 --head flame/
FROM python:3.11-slim AS build
RUN apt-get update && apt-get install --yes --no-install-recommends g++
COPY . /source
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels /source

FROM python:3.11-slim
RUN --mount=from=build,target=/build pip install --no-cache-dir -c /build/source/constraints.txt \
    --extra-index-url https://download.pytorch.org/whl/cpu "$(echo /build/wheels/*.whl)[track,view]"
# Whoever runs it may have no home folder; models stay beside the data.
ENV HOME=/tmp AVATAR_CACHE=/data/.avatar
RUN install --directory --owner=1000 /data
USER 1000
WORKDIR /data
ENTRYPOINT ["avatar"]
