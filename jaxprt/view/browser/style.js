// How the viewer looks: dark and light, wide and narrow.

export const STYLE = `
:host { display: block; height: 100%; }
.frame { --ground: #191a1c; --card: #232528; --field: #303338; --edge: #43474e; --text: #e6e7e9; --dim: #a2a7ae; --mark: #ffc44d; --mark-text: #1c1400;
  --over: #1b1c1ee6; color-scheme: dark; position: relative; display: flex; height: 100%; min-height: 320px; overflow: hidden; box-sizing: border-box;
  background: var(--ground); color: var(--text); font: 12px/1.5 system-ui, sans-serif; accent-color: var(--mark); }
.frame.light { --ground: #e6e8eb; --card: #f8f9fa; --field: #fff; --edge: #c3c8cf; --text: #1d2024; --dim: #565d66; --mark: #9a5b00; --mark-text: #fff;
  --over: #ffffffe6; color-scheme: light; }
.frame *, .frame *::before { box-sizing: border-box; }
.frame [hidden] { display: none !important; }
.stage { position: relative; flex: 1; min-width: 0; min-height: 0; overflow: hidden; }
.canvas { position: absolute; inset: 0; width: 100%; height: 100%; touch-action: none; outline: none; }
.stage:has(.canvas:focus-visible)::after { content: ""; position: absolute; inset: 0; border: 2px solid var(--mark); pointer-events: none; }
button, select, input[type=number], input[type=text] { font: inherit; color: inherit; background: var(--field); border: 1px solid var(--edge); border-radius: 4px; padding: 1px 6px; min-height: 22px; }
button { cursor: pointer; }
button:hover:not(:disabled) { border-color: var(--mark); }
button:disabled { opacity: .5; cursor: default; }
button.main { background: var(--mark); border-color: var(--mark); color: var(--mark-text); font-weight: 600; }
:is(button, select, input, summary, .sky, .plane):focus-visible { outline: 2px solid var(--mark); outline-offset: 1px; }
.tools { position: absolute; top: 8px; right: 8px; display: flex; gap: 4px; }
.tools button { display: grid; place-items: center; width: 30px; height: 30px; padding: 0; background: var(--over); border-radius: 6px; }
.tools svg { width: 16px; height: 16px; fill: none; stroke: currentColor; stroke-width: 1.5; stroke-linecap: round; stroke-linejoin: round; }
.tools button[aria-pressed=true] { color: var(--mark); }
.busy { position: absolute; left: 0; right: 0; top: 0; height: 3px; overflow: hidden; }
.busy::before { content: ""; display: block; height: 100%; width: calc(100% * var(--part, 0.3)); background: var(--mark); transition: width .2s; }
.busy.open::before { animation: along 1.4s ease-in-out infinite; }
@keyframes along { from { transform: translateX(-100%); } to { transform: translateX(334%); } }
.words { position: absolute; left: 8px; top: 8px; max-width: calc(100% - 305px); display: flex; flex-direction: column; align-items: flex-start; gap: 4px; pointer-events: none; }
.stagetext, .told { padding: 2px 8px; border-radius: 4px; background: var(--over); overflow-wrap: anywhere; }
.stagetext { color: var(--dim); font-variant-numeric: tabular-nums; }
.told { border-left: 3px solid var(--mark); }
.line { position: absolute; left: 8px; right: 8px; bottom: 6px; color: #ddd; pointer-events: none; text-shadow: 0 0 3px #000, 0 0 3px #000; }
.hint { position: absolute; left: 50%; bottom: 50px; width: max-content; max-width: calc(100% - 16px); transform: translateX(-50%); padding: 4px 12px; border-radius: 14px; background: var(--over); text-align: center; pointer-events: none; }
kbd { font: inherit; font-weight: 600; padding: 0 4px; border: 1px solid var(--edge); border-radius: 3px; background: var(--field); white-space: nowrap; }
.help { position: absolute; left: 8px; top: 8px; max-width: calc(100% - 16px); max-height: calc(100% - 16px); overflow: auto; padding: 8px 12px 12px; border: 1px solid var(--edge); border-radius: 8px; background: var(--card); }
.help header { display: flex; justify-content: space-between; align-items: center; gap: 12px; font-weight: 600; }
.help td { padding: 1px 12px 1px 0; vertical-align: top; }
.help td:first-child { white-space: nowrap; }
.panel { width: 264px; overflow-y: auto; overscroll-behavior: contain; padding: 4px 10px 12px; background: var(--card); border-left: 1px solid var(--edge); scrollbar-width: thin; }
.gallery { display: flex; gap: 4px; overflow-x: auto; padding: 2px 0 4px; }
.gallery button { flex: 0 0 auto; padding: 1px; line-height: 0; border-radius: 4px; }
.gallery button[aria-pressed="true"] { outline: 2px solid var(--mark); }
.panel summary { cursor: pointer; padding: 4px 0; border-radius: 4px; overflow: hidden; text-overflow: ellipsis; white-space: nowrap; }
.panel > details > summary { font-weight: 600; color: var(--mark); }
.panel > details + details { border-top: 1px solid var(--edge); }
.part { margin: 0 0 2px; padding: 0 0 0 6px; border-left: 2px solid var(--edge); }
.part.picked { border-left-color: var(--mark); }
.row { display: flex; align-items: center; gap: 6px; margin: 3px 0; min-height: 24px; }
.row > span:first-child { flex: 0 0 80px; color: var(--dim); }
.row select { flex: 1; min-width: 0; }
.row input[type=range] { flex: 1; min-width: 0; margin: 0; }
.row input[type=number] { width: 58px; padding: 1px 2px 1px 4px; font-variant-numeric: tabular-nums; }
.row input[type=color] { width: 40px; height: 22px; padding: 0; border: 1px solid var(--edge); border-radius: 4px; background: none; }
.row input[type=text] { flex: 1; min-width: 0; }
.row input[type=checkbox] { margin: 0 0 0 auto; }
.row > span.long { flex: 1; color: var(--text); }
.row button { flex: 1; }
.note { color: var(--dim); margin: 2px 0; }
.sky, .plane { display: block; margin: 4px 0; touch-action: none; cursor: crosshair; border-radius: 4px; }
.sky { width: 100%; aspect-ratio: 2; }
.plane { width: 132px; height: 132px; }
dialog { color: var(--text); background: var(--card); border: 1px solid var(--edge); border-radius: 8px; padding: 12px 16px 16px; width: 320px; max-width: calc(100vw - 32px); }
dialog::backdrop { background: #0008; }
dialog h2 { font-size: 14px; margin: 0 0 8px; }
dialog .row > span:first-child { flex-basis: 130px; }
dialog .row.end { justify-content: flex-end; margin-top: 12px; }
dialog .row.end button { flex: 0 0 auto; padding: 2px 12px; }
.frame.folded .panel { display: none; }
.frame.narrow { flex-direction: column; }
.frame.narrow .panel { width: auto; max-height: 55%; border-left: 0; border-top: 1px solid var(--edge); }
.frame.narrow .row { min-height: 32px; }
.frame.narrow .sky { aspect-ratio: 3.2; }
.frame.narrow .line { display: none; }
.frame.narrow .hint { bottom: 10px; }
.frame.narrow .words { top: 44px; max-width: calc(100% - 16px); }
@media (pointer: coarse) { .tools button { width: 38px; height: 38px; } .row { min-height: 32px; } .panel summary { padding: 8px 0; } }
@media (prefers-reduced-motion: reduce) { .busy.open::before { animation: none; } }
`;
