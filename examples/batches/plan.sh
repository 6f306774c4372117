# Read by slurm.sh and kubernetes.sh: plans the batch of their arguments. PLAN is its address, `tasks STAGE` how many tasks a stage has.
PLANNED=$(vidar plan "$@" --json | tr -d '\n')
PLAN=$(printf %s "$PLANNED" | sed -n 's/.*"plan": *"\([^"]*\)".*/\1/p')
tasks() { printf %s "$PLANNED" | tr -d ' ' | sed -n "s/.*\"stage\":\"$1\",\"tasks\":\([0-9]*\).*/\1/p"; }
