# One image for routers, slaves and masters. It holds no compiler and runs as nobody in particular.

ARG PYTHON=python:3.12.8-slim-bookworm

FROM ${PYTHON} AS build
RUN apt-get update \
    && apt-get install --yes --no-install-recommends gcc libc6-dev \
    && rm -rf /var/lib/apt/lists/*
ENV PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1
RUN python -m venv /opt/doublestep
COPY pyproject.toml README.md LICENSE /source/
COPY protocol /source/protocol
COPY slave_node /source/slave_node
COPY master_node /source/master_node
RUN /opt/doublestep/bin/pip install /source
COPY examples/fmu_framework /source/examples/fmu_framework
COPY examples/quarter_car /source/examples/quarter_car
RUN /opt/doublestep/bin/python /source/examples/quarter_car/build.py \
    && mkdir /models \
    && cp /source/examples/quarter_car/*.fmu /source/examples/quarter_car/*.toml \
          /source/examples/quarter_car/*.py /models/

FROM ${PYTHON}
RUN useradd --uid 10001 --user-group --no-create-home --shell /usr/sbin/nologin doublestep
COPY --from=build /opt/doublestep /opt/doublestep
COPY --from=build /models /models
ENV PATH=/opt/doublestep/bin:$PATH \
    PYTHONDONTWRITEBYTECODE=1 \
    PYTHONUNBUFFERED=1 \
    HOME=/tmp \
    MPLCONFIGDIR=/tmp/matplotlib
WORKDIR /models
USER 10001:10001
CMD ["slave-node", "--help"]
