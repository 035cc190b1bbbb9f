# A command post or a batch run without root: docs/deployment.md.
FROM python:3.11-slim AS built
RUN apt-get update && apt-get install -y --no-install-recommends git libexpat1 && rm -rf /var/lib/apt/lists/*
COPY . /source
WORKDIR /source
RUN python -m venv /opt/orthoswarm \
    && /opt/orthoswarm/bin/pip install --no-cache-dir --no-compile --extra-index-url https://download.pytorch.org/whl/cpu \
        -c requirements.lock . \
    && OMP_NUM_THREADS=1 /opt/orthoswarm/bin/python -P -m orthoswarm.compute.compile_kernels \
    && rm -rf /opt/orthoswarm/lib/python3*/site-packages/torch/test /opt/orthoswarm/lib/python3*/site-packages/torch/include

FROM python:3.11-slim
COPY --from=built /opt/orthoswarm /opt/orthoswarm
# rasterio's wheel expects the system's Expat.
RUN apt-get update && apt-get install -y --no-install-recommends libexpat1 && rm -rf /var/lib/apt/lists/* \
    && useradd --create-home --uid 1000 orthoswarm && install -d -o orthoswarm /data
USER orthoswarm
WORKDIR /data
ENV PATH=/opt/orthoswarm/bin:$PATH OMP_NUM_THREADS=1
VOLUME /data
EXPOSE 8650
ENTRYPOINT ["orthoswarm"]
CMD ["serve", "--bind", "0.0.0.0", "--workspace", "/data/workspace"]
