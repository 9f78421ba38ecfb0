# fd_mitsuba on a CPU, for `docker run`. Not tested by this project's CI, which has no Docker.
#   docker build -t fd_mitsuba .
#   docker run --rm -v "$PWD/runs:/data/runs" fd_mitsuba demo
FROM python:3.12-slim-trixie

RUN apt-get update \
    && apt-get install -y --no-install-recommends libllvm19 \
    && rm -rf /var/lib/apt/lists/*

# First the CPU build of torch, so that the package does not bring the CUDA one.
RUN pip install --no-cache-dir --index-url https://download.pytorch.org/whl/cpu torch==2.13.0

COPY . /src
RUN pip install --no-cache-dir /src && rm -rf /src

WORKDIR /data
ENTRYPOINT ["fd_mitsuba"]
CMD ["doctor"]
